"""Hostile and broken environment files, made by code."""

import struct


def exr_bytes(
    window=(0, 0, 31, 15), version=2, channels=("B", "G", "R"), extra=b"", chunks=None, pixel_type=1
) -> bytes:
    """An uncompressed EXR of zeros, with any false value in its header."""

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    lists = b"".join(c.encode() + b"\0" + struct.pack("<iIii", pixel_type, 0, 1, 1) for c in channels) + b"\0"
    header = struct.pack("<II", 20000630, version)
    header += attribute("channels", "chlist", lists) + attribute("compression", "compression", b"\0")
    header += attribute("dataWindow", "box2i", struct.pack("<4i", *window))
    header += attribute("displayWindow", "box2i", struct.pack("<4i", *window))
    header += attribute("lineOrder", "lineOrder", b"\0") + attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    header += attribute("screenWindowCenter", "v2f", bytes(8))
    header += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + extra + b"\0"
    rows = min(16, max(0, window[3] - window[1] + 1))
    row = len(channels) * 32 * (2 if pixel_type == 1 else 4)
    if chunks is None:
        chunks = [len(header) + 8 * rows + k * (8 + row) for k in range(rows)]
    body = b"".join(struct.pack("<ii", k, row) + bytes(row) for k in range(rows))
    return header + struct.pack(f"<{len(chunks)}Q", *chunks) + body


def _idmanifest() -> bytes:
    return b"ids\0idmanifest\0" + struct.pack("<i", 8) + struct.pack("<II", 0xFFFFFFF0, 8)


def _integer(name: bytes) -> bytes:
    return name + b"\0int\0" + struct.pack("<ii", 4, 0)


def cases() -> list[tuple[str, bytes]]:
    """``(name, content)`` of environment files that must be refused."""
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"
    line = b"-Y 8 +X 16\n"
    row = bytes((2, 2, 0, 16)) + (bytes((128 + 16, 7))) * 4
    good_exr = exr_bytes()
    return [
        ("empty", b""),
        ("text", b"hello"),
        ("hdr_header_only", head),
        ("hdr_no_resolution", head + b"\n"),
        ("hdr_negative", head + b"-Y -8 +X 16\n" + row * 8),
        ("hdr_bomb", head + b"-Y 100000 +X 200000\n" + row),
        ("hdr_bomb_digits", head + b"-Y 9999999999999999 +X 2\n" + row),
        ("hdr_zero", head + b"-Y 0 +X 0\n"),
        ("hdr_words", head + b"-Y eight +X 16\n" + row * 8),
        ("hdr_truncated", head + line + row * 7),
        ("hdr_truncated_run", head + line + row * 7 + row[:-1]),
        ("hdr_run_over_line", head + line + (bytes((2, 2, 0, 16)) + bytes((128 + 17, 7)) * 4) * 8 + bytes(99)),
        ("hdr_zero_run", head + line + row * 7 + bytes((2, 2, 0, 16)) + bytes(99)),
        ("hdr_other_width", head + line + row * 7 + bytes((2, 2, 0, 17)) + row[4:] + bytes(99)),
        ("hdr_flat_truncated", head + b"-Y 2 +X 4\n" + bytes(31)),
        ("hdr_xyze", head.replace(b"rgbe", b"xyze") + line + row * 8),
        ("hdr_exposure", head.replace(b"\n\n", b"\nEXPOSURE=nan\n\n") + line + row * 8),
        ("hdr_not_two_to_one", head + b"-Y 16 +X 16\n" + row * 16),
        ("exr_magic_only", b"\x76\x2f\x31\x01"),
        ("exr_54_bytes", good_exr[:54]),
        ("exr_version", exr_bytes(version=3)),
        ("exr_deep", exr_bytes(version=2 | 0x800)),
        ("exr_multipart", exr_bytes(version=2 | 0x1000)),
        ("exr_unknown_flag", exr_bytes(version=2 | 0x8000)),
        ("exr_tiled_without_tiles", exr_bytes(version=2 | 0x200)),
        ("exr_bomb", exr_bytes(window=(0, 0, 2**30, 2**30))),
        ("exr_bomb_overflow", exr_bytes(window=(-(2**31), -(2**31), 2**31 - 1, 2**31 - 1))),
        ("exr_inverted_window", exr_bytes(window=(31, 15, 0, 0))),
        ("exr_many_channels", exr_bytes(channels=[f"c{i}" for i in range(4000)])),
        ("exr_no_color", exr_bytes(channels=("U", "V"))),
        ("exr_unsigned", exr_bytes(pixel_type=7)),
        ("exr_idmanifest", exr_bytes(extra=_idmanifest())),
        ("exr_attribute_size", exr_bytes(extra=b"a\0string\0" + struct.pack("<i", 2**31 - 1))),
        ("exr_attribute_negative", exr_bytes(extra=b"a\0string\0" + struct.pack("<i", -5))),
        ("exr_many_attributes", exr_bytes(extra=b"".join(_integer(b"a%d" % i) for i in range(999)))),
        ("exr_long_name", exr_bytes(extra=b"a" * 5000)),
        ("exr_chunk_offset", exr_bytes(chunks=[2**60] * 16)),
        ("exr_truncated", good_exr[:-300]),
        ("exr_table_only", exr_bytes(window=(0, 0, 4095, 2047))[:900]),
        ("exr_not_two_to_one", exr_bytes(window=(0, 0, 31, 7))),
    ]
