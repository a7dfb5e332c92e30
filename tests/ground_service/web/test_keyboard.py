"""Pages used with the keyboard while they change, in Chromium."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.ground_service.web.test_in_browser import answered, camera_fault, housekeeping, receive, settled
from tests.lazy import expect
from tests.serving import wait_for

if TYPE_CHECKING:
    from playwright.sync_api import Page

SPACECRAFT = 78
"""Not that of other tests of this service."""

FOCUSED = """() => {
    const one = document.activeElement;
    const row = one.closest("[data-row]");
    return [row?.dataset.row ?? "", one === row ? "row" : one.id || one.textContent.trim()];
}"""


def focused(page: Page) -> tuple[str, str]:
    """Return the row of the focused element, and its identifier or text."""
    row, name = page.evaluate(FOCUSED)
    return row, name


def queue(page: Page) -> str:
    """Enter a telecommand; return its number."""
    answer = page.request.post(
        "/api/v1/telecommands", data={"name": "test_connection", "spacecraft_id": SPACECRAFT}
    )
    return str(answer.json()["id"])


def test_the_focus_stays_on_a_button_when_rows_are_added_above_it(page: Page) -> None:
    settled(page, "/commands")
    before, first = queue(page), queue(page)
    row = page.locator(f'#commands tr[data-row="{first}"]')
    row.get_by_role("button", name="Release").focus()
    second = queue(page)
    expect(page.locator(f'#commands tr[data-row="{second}"]')).to_be_visible()
    assert focused(page) == (first, "Release")
    page.keyboard.press("Enter")
    expect(row).to_contain_text("released")
    answered(page)
    # The button is gone, and no other one is under the finger.
    wait_for(lambda: focused(page) == (first, "row"), "the focus is not in the row")
    page.keyboard.press("Shift+Tab")
    assert focused(page) == (second, "Reject")
    page.keyboard.press("Tab")
    assert focused(page) == (before, "Release")


def test_an_alarm_that_is_acknowledged_leaves_the_focus_in_the_table(page: Page) -> None:
    receive(page, [camera_fault(3000)], SPACECRAFT)
    settled(page, "/alarms")
    row = page.locator("#alarms tbody tr", has_text=f"{SPACECRAFT}, flight")
    row.get_by_role("button", name="Acknowledge").press("Enter")
    expect(row).to_have_count(0)  # its condition had ended
    answered(page)
    assert page.evaluate("document.activeElement.id") == "alarms"


def test_the_last_page_of_a_list_leaves_the_focus_at_the_pager(page: Page) -> None:
    for _ in range(26):
        queue(page)
    settled(page, "/commands")
    older, newer = (page.get_by_role("button", name=name) for name in ("Older", "Newer"))
    expect(older).to_be_enabled()
    older.focus()
    while older.is_enabled():
        shown = page.locator("#range").inner_text()
        older.press("Enter")
        expect(page.locator("#range")).not_to_have_text(shown)
        answered(page)
    expect(newer).to_be_focused()


def test_a_table_keeps_focus_and_scroll_position_while_values_arrive(page: Page) -> None:
    receive(page, [housekeeping(3000, 21.5)], SPACECRAFT)
    page.set_viewport_size({"width": 390, "height": 844})
    settled(page, f"/telemetry?spacecraft={SPACECRAFT}+flight&packet=housekeeping")
    row = page.locator("#live tr", has_text="temperature")
    expect(row).to_contain_text("21.5 °C")
    place = page.get_by_role("group", name="Newest values")
    place.focus()
    place.evaluate("(one) => one.scrollTo(60, 0)")
    receive(page, [housekeeping(3005, 24.25)], SPACECRAFT)
    expect(row).to_contain_text("24.25 °C")
    assert place.evaluate("(one) => [one.scrollLeft, document.activeElement === one]") == [60, True]


def test_a_series_of_a_chart_is_hidden_with_its_band_and_shown_again_with_keys(page: Page) -> None:
    settled(page, "/telemetry?pass=1&chart=1:temperature_c")
    label = page.locator(".chart .u-legend").get_by_role("button", name="temperature")
    shown = "document.querySelector('.chart').plot.series.slice(1).map((one) => one.show)"
    for key, pressed in (("Enter", "false"), (" ", "true")):
        label.press(key)
        expect(label).to_have_attribute("aria-pressed", pressed)
        assert set(page.evaluate(shown)) == {pressed == "true"}
    label.click()
    expect(label).to_have_attribute("aria-pressed", "false")
