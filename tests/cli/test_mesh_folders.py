"""Every command that takes a folder of meshes says how many are in subfolders, and reads them with --recursive."""

import pytest

from tdf_jax.cli.main import main

COMMANDS = {
    "evaluate": ("--pairs", "0"),
    "benchmark": ("--pairs", "0", "--out", "OUT"),
    "shapes": ("--category", "mug", "--out", "OUT.png"),
    "dataset": ("--out", "OUT"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_nested_meshes(tmp_path, capsys, command):
    pytest.importorskip("igl")
    for index in range(2):
        (tmp_path / "meshes" / f"a{index}").mkdir(parents=True)
        (tmp_path / "meshes" / f"a{index}" / "model_normalized.obj").write_text("v 0 0 0\n")
    words = [command, *(word.replace("OUT", str(tmp_path / "out")) for word in COMMANDS[command])]

    def refusal(*more):
        with pytest.raises(SystemExit) as ended:
            main([*words, "--meshes", str(tmp_path / "meshes"), *more])
        assert ended.value.code == 2
        return capsys.readouterr().err

    assert "has 2 meshes in subfolders, which are not used; add --recursive" in refusal()
    found = refusal("--recursive")
    assert "in subfolders" not in found
    assert "a1/model_normalized.obj" in found if command == "dataset" else "has no meshes.json" in found
