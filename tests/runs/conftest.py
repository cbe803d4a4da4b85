"""Runs without their report, which takes as long as a small run, where a test is not about it."""

import pytest
from support.small_run import write_empty_report


@pytest.fixture(autouse=True)
def brief_report(request, monkeypatch):
    """Write an empty page in place of the report, unless the test has the marker `whole_report`."""
    if "whole_report" not in request.keywords:
        monkeypatch.setattr("lfpiv.report.write_report", write_empty_report)
