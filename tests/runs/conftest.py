"""Runs without their report, which takes as long as a small run, where a test is not about it."""

import pytest


@pytest.fixture(autouse=True)
def brief_report(request):
    """Write an empty page in place of the report, unless the test has the marker `whole_report`."""
    if "whole_report" not in request.keywords:
        request.getfixturevalue("empty_report")
