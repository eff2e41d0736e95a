"""A thousand damaged files: no traceback, no hang, nothing left behind; `make fuzz` goes on as long as one likes."""

import os
import time

import fuzz
import pytest


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_a_thousand_damaged_files_give_answers_or_one_line():
    seed, end = int(os.environ.get("LIDARSYNTH_FUZZ_SEED", "0")), time.monotonic() + 60
    bad = [(n, text) for n, _, text in fuzz.run(seed, lambda i: time.monotonic() < end and i < 1000) if text]
    assert not bad, (
        f"cases {[f'{seed}:{n}' for n, _ in bad]}; python tests/fuzz.py --case {seed}:{bad[0][0]}\n{bad[0][1]}"
    )


def test_a_case_is_the_same_on_every_machine():
    import random

    data = b'{"a": 1, "b": [1, 2, 3]}'
    assert fuzz.damaged(data, random.Random("0:7")) == fuzz.damaged(data, random.Random("0:7"))
    assert len({fuzz.damaged(data, random.Random(f"0:{i}")) for i in range(50)}) > 40
