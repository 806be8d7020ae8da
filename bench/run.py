"""Run the cases of the modules of this folder: ``python -m bench.run [NAME ...]``.

A module holds ``CASES = {"name": (builder, arguments)}``; ``builder(device, **arguments)`` builds the inputs and
returns ``(step, work)``: the function to time, and how much one call of it does, e.g. ``{"rays": 1 << 20}``.  It may
hold ``PEERS = {"name": (package, peer_builder)}`` with the same arguments, for another implementation of the same work,
of a package whose version is printed, that is timed in turn with ours.  A builder returns None on a device that its
case does not run on.

Each result is one line of JSON in ``bench/results/<machine>.jsonl``.  ``--record`` writes the ratios, our time by the
peer's, to ``bench/baseline.json`` under this kind of machine (:func:`kind`), which ``pytest bench/`` compares with.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import re
import subprocess
import sys
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path

import torch

from bench.timing import Timing, time_steps

HERE = Path(__file__).parent
BASELINE = HERE / "baseline.json"
PACKAGES = ("reli3d", "torch", "warp-lang", "numpy", "embreex", "mitsuba", "xatlas", "trimesh", "manifold3d")


@dataclass(frozen=True)
class Case:
    builder: Callable
    arguments: dict
    peer: Callable | None
    package: str | None  # of the peer


@dataclass(frozen=True)
class Result:
    work: dict
    ours: Timing
    peer: Timing | None
    peer_name: str | None  # package and version

    @property
    def ratio(self) -> float | None:
        """Our median time by the peer's: below 1 is faster."""
        return None if self.peer is None else self.ours.median / self.peer.median


def collect() -> dict[str, Case]:
    """All cases as ``{"module.name": case}``."""
    found = {}
    for path in sorted(HERE.glob("*.py")):
        if path.stem in ("__init__", "timing", "run", "conftest") or path.stem.startswith("test_"):
            continue
        module = importlib.import_module(f"bench.{path.stem}")
        peers = getattr(module, "PEERS", {})
        for name, (builder, arguments) in getattr(module, "CASES", {}).items():
            package, peer = peers.get(name, (None, None))
            found[f"{path.stem}.{name}"] = Case(builder, arguments, peer, package)
    return found


def measure(case: Case, device: torch.device, *, seconds: float) -> Result | None:
    """Build and time a case and its peer; None where it does not run on ``device``."""
    ours = case.builder(device, **case.arguments)
    if ours is None:
        return None
    peer = case.peer(device, **case.arguments) if case.peer else None
    timings = time_steps([ours[0]] + ([peer[0]] if peer else []), device, seconds=seconds)
    name = f"{case.package} {metadata.version(case.package)}" if peer else None
    return Result(ours[1], timings[0], timings[1] if peer else None, name)


def line(name: str, result: Result) -> str:
    """One row for a person: time, deciles, work a second, memory, ratio."""
    t = result.ours
    text = f"{name:32s} {1e3 * t.median:10.3f} ms [{1e3 * t.p10:.3f}, {1e3 * t.p90:.3f}]"
    text += "".join(f"  {_short(n / t.median)} {unit}/s" for unit, n in result.work.items())
    text += "" if t.peak_bytes is None else f"  +{t.peak_bytes / 2**20:.0f} MiB"
    if result.peer:
        text += f"  {result.ratio:.3f} x {result.peer_name} ({1e3 * result.peer.median:.3f} ms)"
    return text + "".join(f"\n    {stage:28s} {1e3 * s:10.3f} ms" for stage, s in t.stages.items())


def _short(rate: float) -> str:
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if rate >= size:
            return f"{rate / size:.3g} {unit}"
    return f"{rate:.3g} "


def machine(device: torch.device) -> str:
    """Name of the processor and its count (and of the GPU), fit for a file name."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        found = re.search(r"^model name\s*:\s*(.+)$", info.read_text(), re.MULTILINE)
        cpu = found.group(1) if found else cpu
    name = f"{cpu} {os.cpu_count()} cpu"
    if device.type == "cuda":
        name += " " + torch.cuda.get_device_name(device)
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def kind(device: torch.device) -> str:
    """The machine and the vectors that its processor has and the system lets it use: a ratio may depend on them."""
    return f"{machine(device)} {torch.backends.cpu.get_cpu_capability().lower()}"


def context(device: torch.device) -> dict:
    """The conditions of a measurement: versions, commit, machine, threads."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    git = ["git", "-C", str(HERE)]
    commit = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True).stdout.strip()
    changed = subprocess.run(
        [*git, "status", "--porcelain", "-uno", "--", "../reli3d", "*.py"], capture_output=True, text=True
    ).stdout.strip()
    return {
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "device": device.type,
        "machine": machine(device),
        "threads": torch.get_num_threads(),
        "versions": versions,
        "commit": (commit or "none") + ("+changes" if changed else ""),
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.run", description="Time the cases and note the results.")
    parser.add_argument("names", nargs="*", help="modules (triplane) or cases (triplane.gather); all when left out")
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--seconds", type=float, default=3.0, help="time spent on each step, about")
    parser.add_argument("--record", action="store_true", help="also write the ratios to baseline.json")
    parser.add_argument("--no-results", action="store_true", help="print only; append nothing to results/")
    options = parser.parse_args(argv)
    cases = collect()
    unknown = [n for n in options.names if not any(n in (c, c.split(".")[0]) for c in cases)]
    if unknown:
        parser.error(f"names: expected some of {', '.join(cases)}, got {', '.join(unknown)}")
    device = torch.device(options.device)
    about, results, failed = context(device), HERE / "results", 0
    baseline = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    for name, case in cases.items():
        if options.names and name not in options.names and name.split(".")[0] not in options.names:
            continue
        try:
            result = measure(case, device, seconds=options.seconds)
        except Exception:  # a case that fails does not stop the rest
            traceback.print_exc()
            sys.stdout.write(f"{name:32s} failed\n")
            failed += 1
            continue
        if result is None:
            sys.stdout.write(f"{name:32s} does not run on {device}\n")
            continue
        sys.stdout.write(line(name, result) + "\n")
        sys.stdout.flush()
        if not options.no_results:
            results.mkdir(exist_ok=True)
            row = {
                "case": name,
                "work": result.work,
                **asdict(result.ours),
                "ratio": result.ratio,
                "peer": None if result.peer is None else {"name": result.peer_name, **asdict(result.peer)},
                "arguments": case.arguments,
                **about,
            }
            with open(results / f"{about['machine']}.jsonl", "a") as file:
                file.write(json.dumps(row, default=lambda o: o.__name__) + "\n")
        if options.record and result.ratio is not None:
            baseline.setdefault(device.type, {}).setdefault(kind(device), {})[name] = round(result.ratio, 4)
    if options.record:
        BASELINE.write_text(json.dumps(baseline, indent=2, sort_keys=True) + "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
