"""Every case runs, and none has fallen behind its peer: ratios of the same run, never a time.

A ratio is compared with the one recorded on this kind of machine.  A kind that has none is held to a looser bound by
those of the others.  A case without a peer, or whose peer's time is mostly that of a call, is only reported.  After a
deliberate change, and on a kind that shall have its own: ``python -m bench.run --record [NAME ...]``.
"""

import json

import pytest

from bench.run import BASELINE, collect, kind, line, measure

TOLERANCE = 1.5  # other work on the machine moved a ratio of medians by up to 1.25 between runs; a lost factor is 2
ELSEWHERE = 3.0  # of the worst recorded: an AMD with AVX2 took 1.5 times the ratio of an Intel with AVX-512; twice that
CALL = 5e-4  # seconds of a peer; a call of ours costs some 70 us, more than the work of a shorter peer
QUICK = 0.1  # seconds a step, or as many as its fewest runs take
AGAIN = 3.0  # seconds a step if the quick measurement is slower

CASES = collect()


def bound(recorded: dict[str, dict[str, float]], here: str, name: str) -> float:
    """Largest ratio that passes on the kind ``here``, of ratios recorded as ``{kind: {case: ratio}}``."""
    if name in recorded.get(here, {}):
        return TOLERANCE * recorded[here][name]
    known = [ratios[name] for ratios in recorded.values() if name in ratios]
    assert known, f"{name} has a peer but no recorded ratio: python -m bench.run --record {name}"
    return ELSEWHERE * max(known)


@pytest.mark.parametrize("name", CASES)
def test_case_keeps_its_ratio_to_the_peer(device, name, rows):
    result = measure(CASES[name], device, seconds=QUICK)
    if result is None:
        rows.append(f"{name:32s} does not run on {device}")
        return
    recorded = json.loads(BASELINE.read_text()).get(device.type, {})
    if result.ratio is None or result.peer.median < CALL or not recorded:
        rows.append(line(name, result))
        return
    limit = bound(recorded, kind(device), name)
    if result.ratio > limit:
        result = measure(CASES[name], device, seconds=AGAIN)
    rows.append(line(name, result) + f"  at most {limit:.3f}")
    assert result.ratio <= limit, (
        f"{name}: {result.ratio:.3f} x {result.peer_name}, at most {limit:.3f} on {kind(device)}"
    )


def test_a_kind_without_a_ratio_is_held_to_the_looser_bound_by_the_worst_of_the_others():
    recorded = {"a": {"x": 0.2, "y": 1.0}, "b": {"x": 0.3}}
    assert bound(recorded, "a", "x") == TOLERANCE * 0.2
    assert bound(recorded, "b", "y") == ELSEWHERE * 1.0 and bound(recorded, "c", "x") == ELSEWHERE * 0.3
    with pytest.raises(AssertionError, match="bench.run --record z"):
        bound(recorded, "a", "z")
