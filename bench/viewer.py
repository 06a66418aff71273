"""Times of `tdf view` in a browser: from a drag of the object to its new pick, and from an address to the first paint.

Chromium runs without a window and draws on the processor. The medians of five are of real movements of the mouse, and
of loads that alternate with those of a bare page of viser. It needs `pip install 'tdf_jax[dev]'` and Chromium.

    python -m bench.viewer                      # on the imitation of seed 500, which takes some seconds to make
    python -m bench.viewer --folder imitation   # on a folder of `tdf imitate`
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bench.browser import SOFTWARE, browser_program, on_screen
from bench.machine import machine
from tdf_jax._internal.compiled import kept_compiled
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.extras import from_extra
from tdf_jax.cli.main import main as tdf_command
from tdf_jax.solvers.imitation_scene import load_imitation
from tdf_jax.viewer.local_server import address, serving, viser_of
from tdf_jax.viewer.solving import Problem, model_of, problem_of
from tdf_jax.viewer.stage import Stage

COMMAND = "python -m bench.viewer"
SIZE = {"width": 1280, "height": 800}  # of the window, pixels
PATIENCE = 60.0  # seconds until a drag counts as one that changed nothing
SETTLING = 1.5  # seconds in which the browser draws what it was sent
DRAG = 0.06  # metres, to and fro
# On the arrow along y: a quarter of the object's diagonal from its middle, where the arrow is half of it long.
TIP = 0.25
LINE = """[...document.querySelectorAll("p")].map((p) => p.textContent).find((text) => text.startsWith("Solved in"))"""
KEEP_LINE = f"() => {{ window.before = {LINE}; }}"
# The panel has another line, and a frame was drawn after it.
SHOWN = f"""() => {{
  const line = {LINE};
  if (!line || line === window.before) return false;
  return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))));
}}"""
# The canvas counts as painted once it has eight colours, in the frame that drew it: it is blank outside of frames.
WATCH = """
const frame = window.requestAnimationFrame.bind(window);
const small = document.createElement("canvas"); small.width = 64; small.height = 40;
const pen = small.getContext("2d", {willReadFrequently: true});
let last = 0;
window.requestAnimationFrame = (callback) => frame((time) => {
  callback(time);
  const canvas = [...document.querySelectorAll("canvas")].find((one) => one.width > 100);
  if (window.painted || !canvas || performance.now() - last < 50) return;
  last = performance.now();
  pen.clearRect(0, 0, 64, 40);
  pen.drawImage(canvas, 0, 0, 64, 40);
  const bytes = pen.getImageData(0, 0, 64, 40).data, seen = new Set();
  for (let i = 0; i < bytes.length; i += 4) seen.add((bytes[i] << 16) | (bytes[i + 1] << 8) | bytes[i + 2]);
  if (seen.size >= 8) window.painted = performance.now();
});
"""


def drag(page: Any, server: Any, stage: Stage, distance: float) -> dict[str, float]:
    """Drag the object by its arrow, and time the answer to the last movement of the mouse.

    Args:
        page: the page of the viewer.
        server: its server.
        stage: what it shows.
        distance: how far, metres along y.

    Returns:
        Seconds from before the movement to the pick that was found ("found") and to when it is on the screen
        ("shown"), and of them those of the encoding and of the search.

    Raises:
        InputError: no other pick came.
    """
    middle = np.asarray(stage._grip.position)
    tip = middle + [0, TIP * stage._size(), 0]
    start, end = on_screen(server, tip), on_screen(server, tip + [0, distance, 0])
    page.mouse.move(*start)
    page.wait_for_timeout(100)
    page.mouse.down()
    page.mouse.move(*(start + 0.8 * (end - start)), steps=4)
    page.wait_for_timeout(300)
    if not stage.worker.wait(PATIENCE):
        raise InputError(
            f"{COMMAND}: the viewer did not answer in {PATIENCE:g} s; run it on a machine that is not busy"
        )
    page.wait_for_timeout(1000 * SETTLING)
    page.evaluate(KEEP_LINE)
    before, began = stage.solution, time.perf_counter()
    page.mouse.move(*end)
    # The request is made once the browser has sent the movement.
    while stage.solution is before or not stage.worker.wait(0):
        if time.perf_counter() - began > PATIENCE:
            raise InputError(f"{COMMAND}: a drag changed nothing in {PATIENCE:g} s; expected another pick")
        page.wait_for_timeout(5)
    found = time.perf_counter() - began
    page.wait_for_function(SHOWN, timeout=1000 * PATIENCE)
    shown = time.perf_counter() - began
    page.mouse.up()
    page.wait_for_timeout(500)
    encoding, search = stage.solution.seconds or (0.0, 0.0)
    return {"found": found, "shown": shown, "encoding": encoding, "search": search}


def drags(launch: Callable[[], Any], problem: Problem, repetitions: int) -> list[dict[str, float]]:
    """Times of drags to and fro, after the solver was prepared.

    Args:
        launch: starts a browser.
        problem: what the viewer shows.
        repetitions: number of drags.
    """
    with serving(COMMAND, 0) as server:
        stage, chromium = Stage(server, problem), launch()
        try:
            page = chromium.new_page(viewport=SIZE)
            page.goto(address(server))
            page.wait_for_selector("text=Ready: drag the object", timeout=1000 * PATIENCE)
            page.wait_for_timeout(1000 * SETTLING)
            return [drag(page, server, stage, DRAG if number % 2 == 0 else -DRAG) for number in range(repetitions)]
        finally:
            stage.close()
            chromium.close()


def load(launch: Callable[[], Any], url: str, words: str) -> dict[str, float]:
    """Open an address in a browser that has just started, and time its first paint.

    Args:
        launch: starts a browser.
        url: the address.
        words: words of the panel.

    Returns:
        Seconds from the navigation to the first paint ("painted"), and megabytes received by then.
    """
    chromium = launch()
    page = chromium.new_page(viewport=SIZE)
    page.add_init_script(WATCH)
    received = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda data: received.append(len(data))))
    page.on("response", lambda answer: received.append(int(answer.headers.get("content-length", 0))))
    page.goto("about:blank")
    page.wait_for_timeout(1000 * SETTLING)
    page.goto(url)
    page.wait_for_selector(f"text={words}", timeout=1000 * PATIENCE)
    page.wait_for_function("window.painted", polling=50, timeout=1000 * PATIENCE)
    row = {"painted": page.evaluate("window.painted") / 1000, "megabytes": sum(received) / 1e6}
    chromium.close()
    return row


def loads(launch: Callable[[], Any], problem: Problem, repetitions: int) -> dict[str, list[dict[str, float]]]:
    """Times of the first paint of the viewer and of a bare page of viser, in turns.

    Args:
        launch: starts a browser.
        problem: what the viewer shows.
        repetitions: number of loads of each.
    """
    rows: dict[str, list[dict[str, float]]] = {"tdf view": [], "bare viser": []}
    for _ in range(repetitions):
        with serving(COMMAND, 0) as server:
            server.scene.add_grid("/grid")
            server.scene.add_box("/box", dimensions=(1, 1, 1), color=(200, 80, 40))
            server.gui.add_markdown("Nothing here")
            rows["bare viser"].append(load(launch, address(server), "Nothing here"))
        # A server that nobody has opened, so that nothing is prepared yet.
        with serving(COMMAND, 0) as server:
            stage = Stage(server, problem)
            try:
                rows["tdf view"].append(load(launch, address(server), "distinct of"))
            finally:
                stage.close()
    return rows


def measure(folder: Path, repetitions: int) -> dict[str, Any]:
    """Times of the viewer on an imitation.

    Args:
        folder: folder of `tdf imitate`.
        repetitions: number of drags, and of loads of each page.

    Raises:
        InputError: Chromium, playwright or viser is missing, the folder is not of `tdf imitate`, or the browser did
            not answer.
    """
    playwright = from_extra(COMMAND, "playwright.sync_api", "dev", "playwright")
    viser_of(COMMAND)
    program, scene = browser_program(COMMAND), load_imitation(folder)
    with kept_compiled(), playwright.sync_playwright() as driver:

        def launch():
            return driver.chromium.launch(executable_path=program, args=list(SOFTWARE))

        problem = problem_of(scene, model_of(scene, None))
        try:
            return {"paint": loads(launch, problem, repetitions), "drag": drags(launch, problem, repetitions)}
        except playwright.TimeoutError as error:
            raise InputError(
                f"{COMMAND}: the browser did not answer ({str(error).splitlines()[0]}); run it on a machine that is "
                "not busy"
            ) from None


def spread(rows: list[dict[str, float]], name: str) -> str:
    """Median of a number of several rows, with the least and the most.

    Args:
        rows: the rows.
        name: name of the number.
    """
    values = sorted(row[name] for row in rows)
    return f"{statistics.median(values):.2f} ({values[0]:.2f} to {values[-1]:.2f})"


def main() -> None:
    """Measure and print the times, as JSON with --json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, help="folder of `tdf imitate` (default: made with --seed 500)")
    parser.add_argument("--repetitions", type=int, default=5, help="drags, and loads of each page (default: 5)")
    parser.add_argument("--json", action="store_true", help="print the record as JSON")
    options = parser.parse_args()
    if options.repetitions < 1:
        parser.error(f"--repetitions is {options.repetitions}; expected at least 1")
    started = machine()
    try:
        with tempfile.TemporaryDirectory() as scratch:
            folder = options.folder
            if folder is None:
                browser_program(COMMAND)  # before the imitation, which takes longer
                from_extra(COMMAND, "playwright.sync_api", "dev", "playwright")
                folder = Path(scratch) / "imitation"
                tdf_command(["imitate", "--seed", "500", "--no-plots", "--out", str(folder)])
            record = {"machine": started, **measure(folder, options.repetitions), "load_after": machine()["load"]}
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if options.json:
        print(json.dumps(record, indent=1))
        return
    print(
        "machine:",
        ", ".join(f"{name} {value}" for name, value in started.items()),
        f"(load {record['load_after']} after)",
    )
    print(f"medians of {options.repetitions} (least to most)")
    print(f"drag to found pick: {spread(record['drag'], 'found')} s")
    print(f"drag to shown pick: {spread(record['drag'], 'shown')} s")
    print(f"  encoding {spread(record['drag'], 'encoding')} s, search {spread(record['drag'], 'search')} s")
    for name, rows in record["paint"].items():
        print(f"first paint of {name}: {spread(rows, 'painted')} s, {spread(rows, 'megabytes')} MB received")


if __name__ == "__main__":
    main()
