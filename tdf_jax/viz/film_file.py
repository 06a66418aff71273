"""Pictures and films as files: PNG, GIF and MP4."""

import importlib
import io
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from tdf_jax._internal import checks
from tdf_jax._internal.errors import InputError
from tdf_jax._internal.files import replace_file

RATE = 20.0  # pictures a second
COLOURS_OF_GIF = 256
QUALITY = "20"  # constant rate factor of H.264, lower is better: no blocks are seen in these pictures
ENDINGS = (".gif", ".mp4")


def write_frame(path: str | os.PathLike, pixels: UInt8[np.ndarray, "height width 3"]) -> None:
    """Write a picture as PNG.

    Args:
        path: file to write, in an existing folder, `.png`.
        pixels: the picture, (height, width, 3), 0 to 255.

    Raises:
        InputError: the ending is another one, `pixels` is no picture, or the file cannot be written.
    """
    _ending("write_frame()", path, (".png",))
    replace_file("write_frame()", path, _encoded(_image("write_frame()", pixels), "PNG"))


def save_film(path: str | os.PathLike, frames: list[UInt8[np.ndarray, "height width 3"]], rate: float = RATE) -> None:
    """Write pictures as a film.

    Args:
        path: file to write, `.gif` or `.mp4`.
        frames: pictures of one size, (height, width, 3) each, 0 to 255.
        rate: pictures a second.

    Raises:
        InputError: there are no pictures, they have several sizes, the ending is another one, imageio-ffmpeg is
            missing, or the file cannot be written.
    """
    name = "save_film()"
    checks.number(name, "rate", checks.positive(name, "rate", rate), most=50.0)
    ending = _ending(name, path, ENDINGS)
    images = [_image(name, frame) for frame in frames]
    if not images:
        raise InputError(f"{name}: there are no pictures; let the recorder watch the run, or take() one")
    if len({image.size for image in images}) > 1:
        raise InputError(f"{name}: the pictures have several sizes; expected one")
    content = _gif(images, rate) if ending == ".gif" else _mp4(frames, rate)
    replace_file(name, path, content)


def check_encoder(path: str | os.PathLike) -> None:
    """Raise InputError unless a film can be saved under a name; nothing is written.

    Args:
        path: file that is to be written, `.gif` or `.mp4`.

    Raises:
        InputError: the ending is another one, or imageio-ffmpeg is missing.
    """
    if _ending("save_film()", path, ENDINGS) == ".mp4":
        _ffmpeg()


def _ending(function: str, path, endings: tuple[str, ...]) -> str:
    ending = checks.path(function, path).suffix.lower()
    if ending not in endings:
        raise InputError(f"{function}: got {path}; expected a name that ends in {' or '.join(endings)}")
    return ending


def _image(function: str, pixels) -> Any:
    from PIL import Image

    if not isinstance(pixels, np.ndarray) or pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        got = f"{pixels.dtype} {pixels.shape}" if isinstance(pixels, np.ndarray) else type(pixels).__name__
        raise InputError(f"{function}: got a picture of {got}; expected uint8 (height, width, 3)")
    return Image.fromarray(pixels)


def _encoded(image, kind: str, **options) -> bytes:
    content = io.BytesIO()
    image.save(content, kind, **options)
    return content.getvalue()


def _gif(images: list, rate: float) -> bytes:
    """One palette for all pictures, so that colours do not flicker, and no dither, which would be most of the file."""
    from PIL import Image

    some = images[:: max(len(images) // 8, 1)][:9]
    width, height = some[0].size
    sheet = Image.new("RGB", (width, height * len(some)))
    for number, image in enumerate(some):
        sheet.paste(image, (0, number * height))
    palette = sheet.quantize(COLOURS_OF_GIF, method=Image.Quantize.MAXCOVERAGE)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    ticks = np.diff(np.round(np.arange(len(images) + 1) * 100 / rate))  # a GIF counts hundredths of a second
    options = {"save_all": True, "append_images": others, "duration": (10 * ticks).astype(int).tolist(), "loop": 0}
    return _encoded(first, "GIF", **options)


def _mp4(frames: list[np.ndarray], rate: float) -> bytes:
    # Not by `write_frames` of imageio-ffmpeg: it forks this process, of which JAX warns.
    height, width = frames[0].shape[:2]
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{rate:g}", "-i", "-"]
    wanted = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", QUALITY]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.mp4"
        command = [_ffmpeg().get_ffmpeg_exe(), "-loglevel", "error", *given, *wanted, str(file)]
        done = subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), capture_output=True)
        if done.returncode:
            raise InputError(f"save_film(): the encoder failed ({done.stderr.decode(errors='replace').strip()[:300]})")
        return file.read_bytes()


def _ffmpeg() -> Any:
    try:
        return importlib.import_module("imageio_ffmpeg")
    except ImportError:
        raise InputError(
            "save_film(): MP4 needs the package imageio-ffmpeg, which is not installed; expected it: pip install "
            "'tdf_jax[films]', or write a .gif"
        ) from None
