"""The viewer: a stand-in for its window is shown copies of the states, at most as fast as the real time."""

import contextlib
import types

import numpy as np
import pytest
import trimesh

from tdf_jax._internal.errors import InputError
from tdf_jax.sim import campaign, viewer
from tdf_jax.sim.condition import Condition, Settings
from tdf_jax.sim.episode import Outcome
from tdf_jax.sim.imitator import Found, Imitator
from tdf_jax.sim.viewer import Viewer, check_display

mujoco = pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")
window_of = pytest.importorskip("mujoco.viewer", reason="the extra 'sim' is not installed")

CELL = """<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="object" pos="0.5 0 1"><freejoint/><geom type="sphere" size=".06" mass="1"/></body>
  </worldbody>
</mujoco>"""


class Window:
    """Stands in for the handle of MuJoCo's viewer."""

    def __init__(self, model, data):
        self.model, self.data, self.shown, self.open = model, data, [], True
        self.cam = types.SimpleNamespace(lookat=np.zeros(3), distance=0.0, azimuth=0.0, elevation=0.0)
        self.lock = contextlib.nullcontext

    def is_running(self):
        return self.open

    def sync(self):
        self.shown.append((self.data.time, self.data.qpos[2]))
        self.data.qpos[:] = 7  # as a user who drags the object

    def close(self):
        self.open = False


@pytest.fixture
def windows(monkeypatch):
    """The windows that are opened."""
    opened = []

    def launch(model, data, **panels):
        assert panels == {"show_left_ui": False, "show_right_ui": False}
        opened.append(Window(model, data))
        return opened[-1]

    monkeypatch.setattr(window_of, "launch_passive", launch)
    return opened


@pytest.fixture
def clock(monkeypatch):
    """A clock that only sleep moves, and what was slept."""
    slept = []
    monkeypatch.setattr(viewer.time, "monotonic", lambda: 100 + sum(slept))
    monkeypatch.setattr(viewer.time, "sleep", slept.append)
    return slept


def falling():
    model = mujoco.MjModel.from_xml_string(CELL)
    return model, mujoco.MjData(model)


def test_a_run_is_shown_in_real_time_and_stays_as_it_is(windows, clock):
    model, data = falling()
    alone = mujoco.MjData(model)
    with Viewer(model) as shown:
        (window,) = windows
        assert window.model is not model and window.cam.distance > 0
        for _ in range(200):
            mujoco.mj_step(model, data)
            shown.watch(data)
            mujoco.mj_step(model, alone)
    np.testing.assert_array_equal(data.qpos, alone.qpos)
    times, heights = np.array(window.shown).T
    np.testing.assert_allclose(heights, 1 - 9.81 * times**2 / 2, atol=0.03)
    assert 45 < len(times) <= 60 and times[-1] > 0.98  # of a second
    assert sum(clock) == pytest.approx(times[-1] - times[0], abs=1e-6)
    assert not window.open


def test_a_slow_run_is_not_slowed_down(windows, monkeypatch, clock):
    ticks = iter(range(1000))
    monkeypatch.setattr(viewer.time, "monotonic", lambda: next(ticks))  # a second for every look
    model, data = falling()
    with Viewer(model) as shown:
        for _ in range(50):
            mujoco.mj_step(model, data)
            shown.watch(data)
    assert len(windows[0].shown) > 10 and sum(clock) < 1e-6


def test_a_closed_window_is_left_alone(windows, clock):
    model, data = falling()
    with Viewer(model) as shown:
        for step in range(100):
            mujoco.mj_step(model, data)
            shown.watch(data)
            if step == 50:
                windows[0].open = False
    assert max(time for time, _ in windows[0].shown) < 0.3


def test_a_window_that_does_not_open_is_refused(monkeypatch):
    def broken(model, data, **panels):
        raise RuntimeError("no GLX")

    monkeypatch.setattr(window_of, "launch_passive", broken)
    with pytest.raises(
        InputError, match="the window does not open .no GLX.; see what the terminal says, or --animation"
    ):
        Viewer(falling()[0])
    monkeypatch.setattr(viewer, "OPENING", 0.01)
    monkeypatch.setattr(window_of, "launch_passive", lambda model, data, **panels: viewer.threading.Event().wait(5))
    with pytest.raises(InputError, match="nothing after 0.01 s"):
        Viewer(falling()[0])


def test_where_no_window_opens(monkeypatch):
    monkeypatch.setattr("platform.system", lambda: "Linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", "")
    with pytest.raises(InputError, match="neither DISPLAY nor WAYLAND_DISPLAY is set"):
        check_display()
    monkeypatch.setenv("DISPLAY", ":4099")
    with pytest.raises(
        InputError, match=r"no window opens on this display \(.+\); run it on a desktop, or --animation"
    ):
        check_display()
    monkeypatch.setattr("platform.system", lambda: "Darwin")
    with pytest.raises(InputError, match="on macOS no window opens"):
        check_display()


def test_a_kept_episode_runs_again_to_be_shown(windows, clock, tmp_path, monkeypatch):
    model, data = falling()
    cell, runs = types.SimpleNamespace(model=model), []

    def run_episode(episode, robot, candidates, openings, watch=None, **options):
        runs.append(watch)
        for _ in range(20):
            mujoco.mj_step(model, data)
            watch(cell, data, "path")
        return Outcome(True, True, True, True, "", "", 0.0, 0.0)

    def load(settings):
        made = object.__new__(Imitator)
        made.settings, made.condition = settings, settings.condition
        made.fingerprints, made.robot_content, made.robot, made.scans = [], [], None, []
        return made

    monkeypatch.setattr("tdf_jax.sim.episode.run_episode", run_episode)
    monkeypatch.setattr(campaign, "load_imitator", load)
    body = types.SimpleNamespace(mesh=trimesh.creation.box((0.1, 0.1, 0.1)))
    episode = types.SimpleNamespace(
        rejected=0, redrawn=0, T_world_object=np.eye(4), T_world_target=np.eye(4), object_body=body, target_body=body
    )
    monkeypatch.setattr(Imitator, "episode", lambda self, number: (episode, 0))
    found = Found(np.eye(4)[None, None], np.array([0.05]), np.eye(4), "", 1.0, np.zeros((0, 3)))
    monkeypatch.setattr(Imitator, "found", lambda self, episode, shown: found)
    condition = Condition("bowl_on_shelf", "known", "upright", "execute")
    settings = Settings(condition, "bowl", None, 0, tmp_path)
    first = campaign.run_one(settings, 0)
    again = campaign.run_one(settings, 0, view=True)
    assert len(runs) == 2 and first == again
    assert len(windows) == 1 and len(windows[0].shown) == 5 and not windows[0].open


def test_the_first_episode_alone_is_shown(tmp_path, monkeypatch):
    asked = []

    class Pool:
        def submit(self, run, settings, number, view):
            asked.append((number, view))
            return types.SimpleNamespace(result=lambda: number, cancel=lambda: None)

    monkeypatch.setattr(campaign, "process_pool", lambda count: contextlib.nullcontext(Pool()))
    condition = Condition("bowl_on_shelf", "known", "upright", "execute")
    settings = Settings(condition, "bowl", None, 0, tmp_path)
    assert list(campaign.run_campaign(settings, 3, 1, progress=False, view=True)) == [0, 1, 2]
    assert list(campaign.run_campaign(settings, 1, 1, progress=False)) == [0]
    assert asked == [(0, True), (1, False), (2, False), (0, False)]
