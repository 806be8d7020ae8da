"""Every case runs, and none has fallen behind its peer: ratios of the same run, never a time.

A case without a peer is only reported.  After a deliberate change: ``python -m bench.run --record NAME``.
"""

import json

import pytest

from bench import official
from bench.run import BASELINE, collect, line, measure
from reli3d.nn.presets import PRESETS

TOLERANCE = 1.5  # other work on the machine moved a ratio of medians by up to 1.25 between runs; a lost factor is 2
QUICK = 0.1  # seconds a step, or as many as its fewest runs take
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


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_counted_operations_are_those_of_the_specified_sizes(name):
    """Sums of the same products: the counter's and the closed forms' of the specification."""
    preset = PRESETS[name]
    for views in (1, 4):
        assert official.counted(preset, views) == pytest.approx(official.specified_flops(preset, views), rel=1e-9)
    if name == "official":
        assert official.parameters(preset) == official.SPECIFIED
