"""Warnings: kept whatever the log shows, stored as code and figures, worded when read, gathered over pairs."""

import json
import logging
from dataclasses import replace

from support.pair_figures import pair_figures

from lfpiv.runs import result_warnings
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.warn import SENTENCES, Code, FirstOfEachCode, Warning, collected, gather, warn


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


def test_a_warning_of_another_version_is_read():
    stored = {"code": "of_tomorrow", "subject": "left", "figures": {"mm": 2.5}}
    assert Warning.from_json(stored).sentence == "left: of_tomorrow (mm = 2.5)"


def test_warnings_of_several_pairs_are_gathered():
    (found,) = gather([dark(0.25).of_pair(0), dark(0.5).of_pair(1)])
    assert found.sentence.startswith("left, frame a, pairs 0, 1: 25 to 50 % of the bright pixels")
    other = Warning(code=Code.SATURATED, subject="left, frame a", figures={"share": 0.5, "bits": 12})
    assert len(gather([dark(0.5), other])) == 2  # figures of another form are not merged


def test_many_pairs_with_the_same_trouble_are_one_line():
    (found,) = gather(dark(0.1 + number / 1e4).of_pair(number) for number in range(1000))
    assert found.sentence.startswith("left, frame a, pairs 0, 1, 2, 3, 4 and 995 more: 10 to 20 % of the bright pixels")
    (few,) = gather(one for pair in (3, 5) for one in result_warnings.pair_warnings(pair, figures("look", 0.01 * pair)))
    assert few.sentence == "pairs 3, 5: 3 to 5 % of the vectors are valid; look"


def test_volumes_that_explain_little_are_named():
    good = Verdict.GOOD.value
    last = {1: 0.5, 2: 0.8, 4: 0.9}
    pairs = {
        pair: replace(figures(good, 1.0), residual={"a": [0.95, 0.4], "b": [0.99, end]}) for pair, end in last.items()
    }
    (found,) = gather(one for pair, known in pairs.items() for one in result_warnings.pair_warnings(pair, known))
    assert found.code is Code.UNEXPLAINED and found.sentence.startswith("pairs 2, 4: the volumes explain little")
    assert "residual 0.80 to 0.90;" in found.sentence


def figures(verdict, valid_fraction):
    return pair_figures(valid_fraction, verdict=verdict, warnings=(dark(0.1),))


def test_gathered_warnings_come_back_with_their_pairs_and_ranges():
    (found,) = gather(dark(0.1 * pair).of_pair(pair) for pair in (1, 2))
    stored = json.loads(json.dumps(found.to_json()))
    assert stored["pairs"] == [1, 2] and stored["figures"] == {"share": {"low": 0.1, "high": 0.2}}
    assert Warning.from_json(stored) == found


def test_each_code_is_logged_once(caplog):
    log_first = FirstOfEachCode(logging.getLogger("lfpiv.pairs"))
    dim = Warning(code=Code.DIM, figures={"structure": 0.03})
    for pair in range(3):
        log_first(warning.of_pair(pair) for warning in (dark(0.1), dim)[: pair + 1])
    assert [text.split(":")[0] for text in caplog.messages] == ["left, frame a, pair 0", "pair 1"]


def test_figures_of_a_pair_come_back_the_same():
    known = figures("look", 0.5)
    stored = json.loads(json.dumps(known.to_json()))
    assert PairFigures.from_json(stored) == known and stored["uncertainty_voxel"] is None and "stop" not in stored
