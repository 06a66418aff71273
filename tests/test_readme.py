"""The README's snippet runs as printed."""

import re
from pathlib import Path

import numpy as np

README = Path(__file__).parent.parent / "README.md"


def test_the_snippet_runs(capsys):
    (snippet,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names = {}
    exec(snippet, names)
    assert names["result"].loss < 0.9 * names["result"].candidate_history[0, 0]
    assert names["result"].trajectory.matrices.shape == (7, 4, 4)
    assert np.isfinite(names["result"].loss)
    assert capsys.readouterr().out
