"""Tar files, good and hostile, made by code."""

import io
import tarfile
from collections.abc import Callable
from pathlib import Path


def packed(folders: Path, path: Path, form: int = tarfile.PAX_FORMAT) -> Path:
    """The folders in ``folders`` as ``tar`` packs them."""
    with tarfile.open(path, "w", format=form) as tar:
        for folder in sorted(folders.iterdir()):
            tar.add(folder, folder.name)
    return path


def entry(name: str, data: bytes = b"x", **fields) -> tuple[tarfile.TarInfo, bytes]:
    info = tarfile.TarInfo(name)
    info.size = len(data)
    for key, value in fields.items():
        setattr(info, key, value)
    return info, data


def written(*entries: tuple[tarfile.TarInfo, bytes]) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as tar:
        for info, data in entries:
            tar.addfile(info, io.BytesIO(data))
    return out.getvalue()


GOOD = entry("a/word"), entry("a/rgba/0.png"), entry("b/word")


def raw(name: bytes, size: bytes, kind: bytes = b"0") -> bytes:
    """A header with these bytes for the size, and its checksum."""
    block = bytearray(tarfile.TarInfo("x").tobuf(tarfile.USTAR_FORMAT))
    block[:100] = name.ljust(100, b"\0")
    block[124:136] = size.ljust(12, b"\0")
    block[156:157] = kind
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


def pax(record: bytes) -> bytes:
    """A PAX header with one record, then a file of one byte."""
    return raw(b"h", b"%011o" % len(record), b"x") + record.ljust(512, b"\0") + written(entry("a/x"))


def hostile() -> list[tuple[str, Callable[[], bytes], str]]:
    """Name, content, and a word of what is said."""

    def after(*entries):
        return lambda: written(*GOOD, *entries)

    claims = [("2_40", b"\x80" + (1 << 40).to_bytes(11, "big")), ("negative", b"\xff" * 10 + b"\xfe\x00")]
    return [
        ("absolute", after(entry("/etc/evil")), "leads elsewhere"),
        ("above", after(entry("../evil/word")), "leads elsewhere"),
        ("above_deep", after(entry("a/rgba/../../../evil")), "leads elsewhere"),
        ("above_folder", after(entry("../evil", b"", type=tarfile.DIRTYPE)), "leads elsewhere"),
        ("drive", after(entry("c:/evil")), "leads elsewhere"),
        ("backslash", after(entry("a\\..\\evil")), "leads elsewhere"),
        ("symlink", after(entry("b/x", b"", type=tarfile.SYMTYPE, linkname="/etc/passwd")), "a link"),
        ("symlink_long", after(entry("b/x", b"", type=tarfile.SYMTYPE, linkname="../" * 200)), "a link"),
        ("hard_link", after(entry("b/x", b"", type=tarfile.LNKTYPE, linkname="a/word")), "a link"),
        ("device", after(entry("b/x", b"", type=tarfile.CHRTYPE, devmajor=1, devminor=5)), "a device"),
        ("block_device", after(entry("b/x", b"", type=tarfile.BLKTYPE)), "a device"),
        ("pipe", after(entry("b/x", b"", type=tarfile.FIFOTYPE)), "a pipe"),
        ("sparse", after(entry("b/x", type=tarfile.GNUTYPE_SPARSE)), "a sparse file"),
        ("sparse_pax", lambda: pax(b"22 GNU.sparse.major=1\n"), "a sparse file"),
        ("unknown_type", after(entry("b/x", type=b"Z")), "type"),
        *((f"claims_{n}", lambda size=size: raw(b"a/x", size) + bytes(2048), "bytes") for n, size in claims),
        ("long_name_claims", lambda: raw(b"l", b"77777777777", b"L") + bytes(2048), "bytes"),
        ("pax_broken", lambda: pax(b"99 path=x\n"), "PAX"),
        ("pax_negative", lambda: pax(b"11 size=-9\n"), "bytes"),
        ("pax_digits", lambda: pax(b"9" * 400), "PAX"),
        ("pax_path", lambda: pax(b"18 path=/etc/evil\n"), "leads elsewhere"),
        ("pax_large", lambda: raw(b"h", b"%011o" % 70_000, b"x") + bytes(72_000), "header of at most"),
        ("twice", after(entry("b/word")), "each file once"),
        ("file_and_folder", after(entry("b/word/x")), "each file once"),
        ("apart", after(entry("a/other")), "one after another"),
        ("no_object", after(entry("word")), "OBJECT/FILE"),
        ("no_file", after(entry("word.")), "OBJECT/FILE"),
        ("control", after(entry("b/x\x1b[31m")), "printable"),
        ("not_utf8", after(entry("b/\udcff")), "printable"),
        ("long_part", after(entry("b/" + "x" * 256)), "255 bytes"),
        ("long_path", after(entry("b/" + "x/" * 600 + "x")), "1024 characters"),
        ("two_archives", lambda: written(*GOOD) * 2, "more after it"),
        ("cut", lambda: written(*GOOD)[:1500], "cut"),
        ("cut_between", lambda: written(*GOOD)[:3072], "cut"),
        ("empty", lambda: b"", "cut"),
        ("no_entry", lambda: written(), "empty tar file"),
        ("text", lambda: b"not a tar file\n" * 100, "plain tar file"),
        ("compressed", lambda: b"\x1f\x8b\x08" + bytes(range(1, 250)) * 4, "plain tar file"),
    ]
