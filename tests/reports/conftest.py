"""Reports rendered once for all tests of this folder."""

from pytest import fixture

from reports.render import render_html
from tests.reports import example


@fixture(scope="session")
def whole_pass():
    """A pass with everything that a report can show."""
    return example.pass_report(gallery=3, worst=5)


@fixture(scope="session")
def whole_page(whole_pass):
    """Its page."""
    return render_html(whole_pass)
