"""Compiled programs on disk: who keeps them, where, how many, and that the next process does not compile again."""

import os
import subprocess
import sys

import jax
import pytest

from tdf_jax._internal import compiled
from tdf_jax._internal.compiled import FOLDER, kept_compiled
from tdf_jax.cli import main as command

# Sums of sines, which compile for longer than the least that is kept, and the hits that JAX counts.
PROGRAM = """
import jax, jax.numpy as jnp
from tdf_jax._internal.compiled import kept_compiled
hits = []
jax.monitoring.register_event_listener(lambda event, **about: hits.append(event) if event.endswith("cache_hits") else 0)
with kept_compiled():
    print(float(jax.jit(lambda x: sum(jnp.sin(n * x).sum() for n in range(60)))(jnp.ones(7))), len(hits))
"""


@pytest.fixture
def no_choice(monkeypatch, tmp_path):
    """As for a user who has chosen no folder for JAX."""
    monkeypatch.delenv(FOLDER, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = getattr(jax.config, FOLDER.lower())
    jax.config.update(FOLDER.lower(), None)
    yield tmp_path
    jax.config.update(FOLDER.lower(), before)


def test_a_command_keeps_programs_in_the_users_cache_and_leaves_no_setting_behind(no_choice):
    seconds = jax.config.jax_persistent_cache_min_compile_time_secs
    with kept_compiled():
        folder = os.environ[FOLDER]
        assert folder.startswith(str(no_choice / "tdf_jax" / "compiled" / "jaxlib-"))
        assert getattr(jax.config, FOLDER.lower()) == folder and os.path.isdir(folder)
        assert jax.config.jax_persistent_cache_min_compile_time_secs == 0.05
    assert FOLDER not in os.environ and getattr(jax.config, FOLDER.lower()) is None
    assert jax.config.jax_persistent_cache_min_compile_time_secs == seconds


def test_the_next_process_does_not_compile_again(no_choice):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(2)
    )
    assert first[0] == second[0]
    assert int(first[1]) == 0 and int(second[1]) > 0


def test_a_folder_that_the_user_chose_stays(no_choice, monkeypatch):
    monkeypatch.setenv(FOLDER, "/elsewhere")
    with kept_compiled():
        assert os.environ[FOLDER] == "/elsewhere"
    assert not (no_choice / "tdf_jax").exists()


def test_where_nothing_can_be_written_nothing_is_kept(no_choice, monkeypatch):
    (no_choice / "tdf_jax").write_text("a file where the folder would be")
    with kept_compiled():
        assert FOLDER not in os.environ
    (no_choice / "tdf_jax").unlink()
    monkeypatch.setattr(compiled.os, "access", lambda *about: False)  # a folder of somebody else
    with kept_compiled():
        assert FOLDER not in os.environ


def test_the_longest_unused_programs_are_removed(no_choice, monkeypatch):
    with kept_compiled():
        folder = compiled.Path(os.environ[FOLDER])
    for number in range(5):
        (folder / f"program{number}").write_bytes(bytes(100))
        os.utime(folder / f"program{number}", (1000 + number, 1000 + number))
    monkeypatch.setattr(compiled, "LARGEST", 250)
    with kept_compiled():
        assert sorted(one.name for one in folder.iterdir()) == ["program3", "program4"]


@pytest.mark.parametrize(("words", "calls"), [(["imitate", "--help"], 1), (["imitate", "--no-cache", "--help"], 0)])
def test_no_cache_is_an_option_of_every_command(monkeypatch, capsys, words, calls):
    called = []

    def kept():
        called.append(1)
        return kept_compiled()

    monkeypatch.setattr(command, "kept_compiled", kept)
    with pytest.raises(SystemExit) as ended:
        command.main(words)
    assert ended.value.code == 0 and len(called) == calls and "--target" in capsys.readouterr().out
