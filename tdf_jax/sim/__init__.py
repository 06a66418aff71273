"""A robot in physics: trajectories as motions of joints, executed in MuJoCo, and counted by the field's protocols.

Modules:
    physics: settings of the physics in one place, and the import of the engine
    fingers: the fingers of a gripper, measured in the physics
    robot: an arm and a gripper, from a package or from a file
    grip_site: the site of the gripper's frame that a model lacks
    board: a board at a height, the shelf of the tasks
    bodies: rigid bodies of generated objects
    decomposition: convex parts of users' meshes, and the bodies that they make
    scans: objects of users' annotated meshes
    workcell: the table, an arm or a floating gripper, the object and the target
    cameras: depth cameras around a cell, and clouds of what they see
    segmentation: the cloud of one body from images of the whole scene
    removal_study: what the removal of a table and of flying pixels costs
    kinematics: inverse kinematics of an arm, at a pose and along a path
    configurations: the distinct positions of the joints with which the gripper is at a pose
    gripper_path: dense poses along a trajectory, and the joints with which the arm follows them
    collision: what touches what at planned positions, and what a plan may touch
    rrt: free motions from one configuration to another
    joint_trajectory: a timed motion of the joints, and its files
    retiming: times of a path of the joints within limits of velocity and acceleration
    motion: motions of a robot along a trajectory, from home to home
    motion_study: how many reachable tasks the planner solves, and in what time
    execution: a joint trajectory in physics
    pads: flat pads, and the turn at which what they clamp lies flush with them
    necks: how pads hold a neck, and a neck in a cloud
    grasps: grasps of generated objects that a demonstration shows
    grasping: whether a grasp holds an object that is lifted and turned
    approach_study: how many objects a gripper can approach as demonstrated
    centring: a grasp in the middle of what is between the fingers
    swing: turning a hand so that what it holds does not swing
    tasks: what is picked, where it goes, and where objects start
    replay: baselines: the demonstrated path by other means, and the paper's energy
    placement: whether an object is placed, once it has settled
    episode: one task from the start to the settled end
    condition: what a row of episodes is measured under, and what its episodes share
    imitator: what is imitated in the episodes of a campaign
    campaign: many episodes in several processes
    report: success, causes of failure, and the record of a run
    published: published success rates, and which rows stand beside them
    rows: campaigns that are planned together, and what became of the episodes of each
    sentences: what they show together, computed from their outcomes
    comparison: the page of many campaigns beside published rates, and their record
    recording: pictures and films of a cell
    solids: what the bodies of a cell look like, by few triangles
    playback: what a picture of an episode needs, and its file
    playback_page: the page of an episode
    failures: pictures of failed episodes
    viewer: MuJoCo's own viewer on a cell while it runs
"""
