"""Every case runs, and none has fallen behind its peer: ratios of the same run, never a time.

A case without a peer is only reported.  After a deliberate change: ``python -m bench.run --record NAME``.
"""

import json

import pytest

from bench.run import BASELINE, collect, line, measure

TOLERANCE = 1.5  # other work on the machine moved a ratio of medians by up to 1.25 between runs; a lost factor is 2
QUICK = 0.5  # seconds a step
AGAIN = 3.0  # seconds a step when the quick look says slower

CASES = collect()


@pytest.mark.parametrize("name", CASES)
def test_case_keeps_its_ratio_to_the_peer(device, name, rows):
    result = measure(CASES[name], device, seconds=QUICK)
    if result is None:
        rows.append(f"{name:32s} does not run on {device}")
        return
    recorded = json.loads(BASELINE.read_text()).get(device.type, {})
    if result.ratio is None or not recorded:
        rows.append(line(name, result))
        return
    assert name in recorded, f"{name} has a peer but no recorded ratio: python -m bench.run --record {name}"
    limit = TOLERANCE * recorded[name]
    if result.ratio > limit:
        result = measure(CASES[name], device, seconds=AGAIN)
    rows.append(line(name, result) + f"  recorded {recorded[name]:.3f}")
    assert result.ratio <= limit, f"{name}: {result.ratio:.3f} x peer, recorded {recorded[name]:.3f}"
