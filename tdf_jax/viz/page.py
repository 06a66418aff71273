"""A page for a browser: one file that holds plotly's script, compressed, and opens without a network."""

import base64
import dataclasses
import gzip
import html
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from tdf_jax._internal.errors import InputError
from tdf_jax._internal.extras import from_extra
from tdf_jax._internal.files import replace_file
from tdf_jax.viz.style import INK

LARGEST = 5_000_000  # bytes of a page: mail and issue trackers take it
HEIGHT = 560  # pixels, of a page in a notebook
DIAGONAL = 1.9  # of a scene, in plotly's unit
TIMELINE = """
<div id="timeline"><button id="play">Play</button>
<input id="time" type="range" min="0" max="%d" value="0" aria-label="time"><span id="pose"></span></div>
"""
PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>%(title)s</title>
<style>
body {margin: 0; font: 15px system-ui, sans-serif; color: %(ink)s; height: 100vh; display: flex; flex-direction: column}
h1 {font-size: 17px; font-weight: 600; margin: 10px 14px 0}
p {margin: 4px 14px}
#figure {flex: 1; min-height: 300px}
#timeline {display: flex; gap: 12px; align-items: center; padding: 8px 14px}
#time {flex: 1}
#play {width: 70px; font: inherit}
#pose {min-width: 190px}
</style></head><body>
<h1>%(title)s</h1>%(lead)s
<div id="figure"><p id="waiting">Opening ...</p></div>%(timeline)s
<noscript><p>This page draws with JavaScript; allow it for this file.</p></noscript>
<!-- plotly.js, MIT licence, copyright Plotly, Inc.: compressed -->
<script type="text/plain" id="plotly">%(plotly)s</script>
<script type="text/plain" id="content">%(content)s</script>
<script>
async function unpacked(id) {
  const text = document.getElementById(id).textContent;
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}

function moved(points, motion) {
  const [R, t] = motion;
  const axis = (i) => points[0].map((x, k) => x === null ? null :
    R[i][0] * x + R[i][1] * points[1][k] + R[i][2] * points[2][k] + t[i]);
  return [axis(0), axis(1), axis(2)];
}

function placed(one, frame) {
  const parts = (one.parts || [one]).map((part) => moved(part.points, part.motions[frame]));
  return [0, 1, 2].map((axis) => parts.flatMap((part) => part[axis]));
}

async function open() {
  const script = document.createElement("script");
  script.textContent = await unpacked("plotly");
  document.head.append(script);
  const content = JSON.parse(await unpacked("content"));
  const figure = document.getElementById("figure");
  document.getElementById("waiting").remove();
  await Plotly.newPlot(figure, content.data, content.layout, {responsive: true, displaylogo: false});
  if (content.moving) animated(figure, content);
  document.body.dataset.ready = "1";
}

function animated(figure, content) {
  const slider = document.getElementById("time"), button = document.getElementById("play");
  const traces = content.moving.map((one) => one.trace);
  let playing = false, drawing = false, wanted = null, began = 0, from = 0;
  async function show(frame) {
    wanted = frame;
    if (drawing) return;
    drawing = true;
    while (wanted !== null) {
      const now = wanted;
      wanted = null;
      const shown = content.moving.map((one) => placed(one, now));
      await Plotly.restyle(figure, {x: shown.map((p) => p[0]), y: shown.map((p) => p[1]), z: shown.map((p) => p[2])},
                           traces);
      document.getElementById("pose").textContent = content.labels[now];
      document.body.dataset.frame = now;
    }
    drawing = false;
  }
  function tick(time) {
    if (!playing) return;
    if (!began) began = time;
    const last = content.labels.length - 1;
    const frame = Math.min(last, from + Math.floor((time - began) / 1000 * content.rate));
    slider.value = frame;
    show(frame);
    if (frame === last) return stop();
    requestAnimationFrame(tick);
  }
  function stop() {
    playing = false;
    button.textContent = "Play";
  }
  button.onclick = () => {
    if (playing) return stop();
    playing = true;
    button.textContent = "Pause";
    from = Number(slider.value) === content.labels.length - 1 ? 0 : Number(slider.value);
    began = 0;
    requestAnimationFrame(tick);
  };
  slider.oninput = () => {
    stop();
    show(Number(slider.value));
  };
  document.getElementById("pose").textContent = content.labels[0];
}

open().catch((error) => {
  document.body.insertAdjacentHTML("afterbegin", "<p>This page needs a browser of 2023 or later with WebGL.</p>");
  throw error;
});
</script></body></html>
"""


def pages(function: str) -> Any:
    """The plotly module that draws pages.

    Args:
        function: name that the error message begins with.

    Raises:
        InputError: it is not installed.
    """
    return from_extra(function, "plotly.graph_objects", "pages", "plotly")


@dataclasses.dataclass(frozen=True)
class Page:
    """A page that opens without a network, and shows itself in a notebook.

    Attributes:
        text: the page, HTML.
        function: name that error messages begin with.
        height: height in a notebook, pixels.
    """

    text: str = dataclasses.field(repr=False)
    function: str = "page()"
    height: int = HEIGHT

    def save(self, path: str | os.PathLike) -> None:
        """Write the page as a file.

        Args:
            path: the .html file, in an existing folder; it appears only once it is complete.

        Raises:
            InputError: the file cannot be written.
        """
        replace_file(self.function, Path(path), self.text.encode())

    def _repr_html_(self) -> str:
        # A page within the page: its script and its style are its own, and the notebook keeps it.
        inside = html.escape(self.text)
        return f'<iframe srcdoc="{inside}" style="width: 100%; height: {self.height}px; border: 0"></iframe>'


def page_of(function: str, figure: Any, title: str, lead: str = "", motion: dict | None = None) -> Page:
    """A figure of plotly as a page.

    Args:
        function: name that error messages begin with.
        figure: the `plotly.graph_objects.Figure`.
        title: title of the page.
        lead: lines under the title, plain text.
        motion: what moves, in types of JSON: "labels", one for each frame; "rate", frames a second; and "moving": for
            each moving trace its number "trace", its "points", (3, points), in the frame that moves, and its "motions",
            a rotation (3, 3) and a translation (3,) for each frame; or instead of these two "parts", each with both,
            whose points are those of the trace one after the other. None if nothing moves.

    Raises:
        InputError: the page would have more than `LARGEST` bytes.
    """
    from plotly.offline import get_plotlyjs

    content = json.loads(figure.to_json()) | (motion or {})
    text = PAGE % {
        "title": html.escape(title),
        "lead": "".join(f"<p>{html.escape(line)}</p>" for line in lead.splitlines()),
        "ink": INK,
        "timeline": TIMELINE % (len(motion["labels"]) - 1) if motion else "",
        "plotly": _packed(get_plotlyjs()),
        "content": _packed(json.dumps(content, separators=(",", ":"))),
    }
    if len(text) > LARGEST:
        raise InputError(
            f"{function}: the page would have {len(text) / 1e6:.1f} MB; expected at most {LARGEST / 1e6:g} MB. Use "
            "fewer points, a coarser grid or a mesh with fewer triangles"
        )
    return Page(text, function)


def camera(angles: dict[str, float], distance: float) -> dict:
    """The camera of a scene of plotly.

    Args:
        angles: "elev" and "azim", degrees, as matplotlib has them.
        distance: distance from the middle of the scene, in its size.
    """
    azimuth, height = np.radians(angles["azim"]), np.radians(angles["elev"])
    eye = distance * np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    return {"eye": dict(zip("xyz", eye.tolist())), "center": {"x": 0, "y": 0, "z": -0.1}}


def scene_axes(low: np.ndarray, high: np.ndarray) -> dict[str, Any]:
    """Axes of a scene of plotly at one scale, so that every scene fills its place alike.

    Args:
        low: least coordinates of what is shown, (3,), centimetres.
        high: largest coordinates.
    """
    look = {"backgroundcolor": "#f7f7f7", "gridcolor": "#dedede", "showbackground": True}
    ticks = np.round(2 + 4 * (high - low) / (high - low).max())  # those of a short axis would touch
    axes = {
        f"{axis}axis": look | {"title": f"{axis} (cm)", "range": listed(np.array([least, most])), "nticks": int(count)}
        for axis, least, most, count in zip("xyz", low, high, ticks)
    }
    ratio = DIAGONAL * (high - low) / np.linalg.norm(high - low)
    return axes | {"aspectmode": "manual", "aspectratio": dict(zip("xyz", listed(ratio)))}


def listed(values: np.ndarray, digits: int = 3) -> list:
    """Numbers as lists of JSON, rounded: digits are most of a page."""
    return np.round(np.asarray(values, float), digits).tolist()


def _packed(text: str) -> str:
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()
