"""Runs without their report and without the comparison of cameras, which take longer than a small run's pairs."""

import pytest


@pytest.fixture(autouse=True)
def brief_runs(request):
    """Keep runs brief, unless the test has the marker `whole_run`."""
    if "whole_run" not in request.keywords:
        request.getfixturevalue("brief_run")
