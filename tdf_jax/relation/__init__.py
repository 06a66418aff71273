"""Relations: where an object goes on a second object, the target, from the region where the two met in a demonstration.

The region is found twice, by descriptors: on the target as it stands, pose X_t of the contact frame, and on the object
in its initial pose, X_o. The object's motion M = X_t inverse(X_o) brings the two together. With the demonstrated
motion D of the object, and the motions A_t of the region on the target and A_o of the region on the object,
M = A_t D inverse(A_o).

Modules:
    two_objects: the clouds, the fields and the reference of an object and its target, checked
    regions: the contact region on one object, found by descriptors and registered by points
    object_motion: `relate`: motions of the object, seated on its target
    placed_path: the demonstrated path from the pick to the place that a motion gives
"""
