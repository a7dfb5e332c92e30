"""Reports rendered once for all tests of this folder."""

import pytest

from reports.render import render_html
from tests.reports import example


@pytest.fixture(scope="session")
def whole_pass():
    """A pass with everything that a report can show."""
    return example.pass_report(gallery=3, worst=5)


@pytest.fixture(scope="session")
def whole_page(whole_pass):
    """Its page."""
    return render_html(whole_pass)
