"""Warnings: kept whatever the log shows, stored as code and figures, worded when read, gathered over pairs."""

import json
import logging

import pytest

from lfpiv.runs import summary_warnings
from lfpiv.warn import SENTENCES, Code, Warning, collected, gather, warn


def dark(share):
    return Warning(code=Code.SATURATED, subject="left, frame a", figures={"share": share})


def test_warnings_are_kept_whatever_the_log_shows():
    log = logging.getLogger("lfpiv.silent")
    log.setLevel(logging.CRITICAL)
    warn(log, dark(0.0))
    with collected() as outer:
        warn(log, dark(0.1))
        with collected() as inner:
            warn(log, dark(0.2))
            warn(log, dark(0.2))
        warn(log, dark(0.3))
    assert outer == [dark(0.1), dark(0.3)] and inner == [dark(0.2)]


def test_every_code_has_a_sentence():
    assert set(SENTENCES) == set(Code)


def test_a_stored_warning_comes_back_the_same():
    warning = dark(0.12)
    stored = json.loads(json.dumps(warning.to_json()))
    assert stored == {"code": "saturated", "subject": "left, frame a", "figures": {"share": 0.12}}
    assert Warning.from_json(stored) == warning
    assert warning.sentence.startswith("left, frame a: 12 % of the bright pixels are saturated")


@pytest.mark.parametrize(
    ("stored", "sentence"),
    [
        ("left: the dots look odd", "left: the dots look odd"),
        ({"code": "of_tomorrow", "subject": "left", "figures": {"mm": 2.5}}, "left: of_tomorrow (mm = 2.5)"),
        ({"what": "saturated", "camera": "left", "frame": "b", "value": 0.25}, "left, frame b: 25 % of the bright"),
        (
            {"what": "uneven", "camera": "left", "frame": "", "value": 3.0},
            "left: 3 of 9 parts of the sensor are 4 times",
        ),
    ],
    ids=["sentence of 0.1.0", "unknown code", "finding of 0.1.0", "finding of both frames"],
)
def test_warnings_of_other_versions_are_read(stored, sentence):
    assert Warning.from_json(stored).sentence.startswith(sentence)


def test_many_pairs_with_the_same_trouble_are_one_line():
    (found,) = gather(dark(0.1 + number / 1e4).of_pair(number) for number in range(1000))
    assert found.sentence.startswith("left, frame a, pairs 0, 1, 2, 3, 4 and 995 more: 10 to 20 % of the bright pixels")
    poor = [{"pair": number, "verdict": "look", "valid_fraction": 0.01 * number} for number in (3, 5)]
    (few,) = summary_warnings.pair_warnings(poor)
    assert few.sentence == "pairs 3, 5: 3 to 5 % of the vectors are valid; look"
