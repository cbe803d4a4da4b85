"""Every default lives once: calls have those of the experiment file's tables."""

import dataclasses
import inspect

import pytest

import lfpiv
from lfpiv.joint.pair import PairSolver
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.settings.processing import Compute, Correlation, Smart, Tracking
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.velocity.settings import CorrelationSettings


def defaults(call):
    """Name -> default of the parameters of a call that have one."""
    given = inspect.signature(call).parameters.values()
    return {one.name: one.default for one in given if one.default is not inspect.Parameter.empty}


@pytest.mark.parametrize(
    ("call", "table", "keys"),
    [
        (lfpiv.reconstruct, Smart(), set(Smart().of_one_frame()) & set(defaults(lfpiv.reconstruct))),
        (SmartSettings, Smart(), set(Smart().of_one_frame())),
        (lfpiv.reconstruct_pair, Smart(), {"estimate"}),
        (PairSolver, Smart(), {"estimate"}),
        (lfpiv.correlate, Correlation(), set(Correlation.model_fields)),
        (lfpiv.find_particles, Tracking(), set(Tracking().search)),
        (ParticleSearch, Tracking(), set(Tracking().search)),
    ],
)
def test_calls_have_the_defaults_of_the_tables(call, table, keys):
    found = defaults(call)
    assert keys <= set(found)
    assert {key: found[key] for key in keys} == {key: getattr(table, key) for key in keys}


def test_weights_have_the_defaults_of_the_table():
    found, table = defaults(lfpiv.build_weights), Compute()
    assert (found["method"], found["form"]) == (table.weights, table.weights_form)
    assert found["rays"] == table.count_rays


def test_no_setting_of_a_table_is_missing_from_its_call():
    """`measure_pair` has the others, which no single step knows: guard layers, refinement, prediction."""
    of_one = {field.name for field in dataclasses.fields(SmartSettings)}  # `reconstruct` takes them by their names
    assert set(Smart.model_fields) - of_one == {"estimate", "refinement", "predict"}
    assert {field.name for field in dataclasses.fields(CorrelationSettings)} == set(Correlation.model_fields)
