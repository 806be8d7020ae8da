"""Encodes MP4 video with PyAV (``av``), an optional dependency whose wheel includes FFmpeg's libraries."""

import importlib
import io
from types import ModuleType

from PIL import Image

BT709, LIMITED = 1, 1  # FFmpeg's numbers of the color space that players assume for HD, and of its range
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
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = BT709
        context.color_range = LIMITED
        for image in frames:
            if image.mode == "RGBA":
                image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
            frame = av.VideoFrame.from_image(image.convert("RGB"))
            limited = {"dst_colorspace": "ITU709", "dst_color_range": "MPEG"}
            file.mux(stream.encode(frame.reformat(format="yuv420p", **limited)))
        file.mux(stream.encode())
    return data.getvalue()
