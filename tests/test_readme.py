"""The README's snippet runs as printed, with fewer iterations."""

import re
from pathlib import Path

import numpy as np

README = Path(__file__).parent.parent / "README.md"


def test_the_snippet_runs(capsys):
    (snippet,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert snippet.count("iterations=100") == 1
    names = {}
    exec(snippet.replace("iterations=100", "iterations=2"), names)
    assert names["result"].losses.shape == (10, 2)
    assert names["result"].trajectory.matrices.shape == (7, 4, 4)
    assert np.isfinite(names["result"].loss)
    assert capsys.readouterr().out
