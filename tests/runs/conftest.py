"""Runs without their report, which takes as long as a small run, where a test is not about it."""

import pytest


@pytest.fixture(autouse=True)
def brief_report(request, monkeypatch):
    """Write an empty page in place of the report, unless the test has the marker `whole_report`."""
    if "whole_report" not in request.keywords:
        monkeypatch.setattr("lfpiv.report.write_report", lambda *given: given[-1].write_text("", "utf-8"))
