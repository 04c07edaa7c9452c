"""What names the trials of a batch by their content."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from logged import RIGS, record

TRIALS = 4


def test_digests_tell_equal_trials_from_others():
    batch = record(RIGS["falcon"], TRIALS, rows=60)
    assert batch.digests == record(RIGS["falcon"], TRIALS, rows=60).digests
    others = [replace(batch, damping=batch.damping + 1e-9), replace(batch, position=np.nextafter(batch.position, 1.0))]
    known = {each for one in (batch, *others) for each in one.digests}
    assert len(known) == 3 * TRIALS
    # 64 bits: of a million trials two are alike once in 4e7
    assert {len(each) for each in known} == {16}
