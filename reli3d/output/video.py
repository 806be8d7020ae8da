"""Encodes MP4 video with PyAV (``av``), an optional dependency whose wheel includes FFmpeg's libraries."""

import importlib
import io
from types import ModuleType

from PIL import Image

QUALITY = "18"  # x264's constant rate factor: no difference is seen from the frames


def library() -> ModuleType:
    """PyAV.  Raises ImportError that names what to install if it is missing."""
    try:
        return importlib.import_module("av")
    except ModuleNotFoundError as error:
        raise ImportError("av is not installed: pip install 'reli3d[video]'", name="av") from error


def mp4_bytes(frames: list[Image.Image], rate: int) -> bytes:
    """MP4 file, H.264 in 4:2:0, of ``frames`` of equal, even size, composited over white if they have alpha."""
    av = library()
    data = io.BytesIO()
    with av.open(data, "w", format="mp4") as file:
        stream = file.add_stream("libx264", rate=rate, options={"crf": QUALITY})
        stream.width, stream.height = frames[0].size
        stream.pix_fmt = "yuv420p"
        for image in frames:
            if image.mode == "RGBA":
                image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
            frame = av.VideoFrame.from_image(image.convert("RGB"))
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return data.getvalue()
