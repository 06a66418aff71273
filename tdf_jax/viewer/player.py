"""A slider over time, with a button that plays it."""

import threading
import time
from collections.abc import Callable
from typing import Any

RATE = 20.0  # frames a second
SPEEDS = {"quarter speed": 0.25, "real time": 1.0, "four times": 4.0}  # of seconds; the choices of a panel


class Player:
    """A slider over time, and a button that plays it to the end.

    Attributes:
        slider: the slider of viser.
        button: the button of viser.
        lock: held while a frame is shown; whoever moves what is shown holds it too.
        speed: units of the slider a second.
    """

    def __init__(
        self, gui: Any, label: str, last: float, step: float, first: float, speed: float, show: Callable[[], None]
    ):
        """Add both to a panel.

        Args:
            gui: the panel, `viser.GuiApi`.
            label: name of the slider.
            last: its last value; it begins at 0.
            step: its step.
            first: value that is shown first.
            speed: units of the slider a second.
            show: shows the value of the slider.
        """
        self.lock, self.speed = threading.RLock(), speed
        self._step, self._show = step, show
        self._playing: threading.Event | None = None
        self.slider = gui.add_slider(label, 0.0, max(float(last), step), step, float(first))
        self.button = gui.add_button("Play")
        self.slider.on_update(self.moved)
        self.button.on_click(lambda _: self.stop() if self.playing else self.start())

    @property
    def playing(self) -> bool:
        """Whether it plays."""
        return self._playing is not None

    @property
    def value(self) -> float:
        """Value of the slider."""
        return float(self.slider.value)

    @value.setter
    def value(self, value: float) -> None:
        self.slider.value = float(value)

    def extend(self, last: float) -> None:
        """Set the last value of the slider."""
        self.slider.max = max(float(last), self._step)

    def moved(self, event: Any) -> None:
        """Show the value of the slider; the user's hand stops the player."""
        if event.client_id is not None:  # not the player
            self.stop()
        self._show()

    def start(self) -> None:
        """Play from the value of the slider to the end; at the end, from the beginning."""
        self._playing = stop = threading.Event()
        self.button.label = "Pause"
        if self.value >= self.slider.max - self._step / 2:
            self.value = 0.0

        def run():
            began, first = time.monotonic(), self.value
            while not stop.wait(1 / RATE):
                place = first + self.speed * (time.monotonic() - began)
                with self.lock:
                    if stop.is_set():
                        break
                    last = float(self.slider.max)
                    self.value = min(last, round(place / self._step) * self._step)
                    if place >= last:
                        self.stop()

        threading.Thread(target=run, daemon=True).start()

    def stop(self) -> None:
        """Stop playing."""
        with self.lock:
            playing, self._playing = self._playing, None
            if playing is not None:
                playing.set()
                self.button.label = "Play"
