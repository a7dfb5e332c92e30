"""Names and reasons are one printable line."""

import pytest
from pydantic import BaseModel, Field, ValidationError

from ground_service.errors import InvalidInput
from ground_service.text import LINE_PATTERN_JSON, require_line

BAD = ["a\nb", "\x1b[31m", "\x00", "tab\t", "\x7f", "\x85", "\u2028", "\u202e", "\u2066"]


class Named(BaseModel):
    """A model with a name, as requests have them."""

    name: str = Field(pattern=LINE_PATTERN_JSON)


@pytest.mark.parametrize("text", ["evening pass", "Überflug 7", "\u6708 \U0001f315", "a/b: c=1"])
def test_a_printable_line_is_taken_as_it_is(text: str) -> None:
    assert require_line(text, "window", "name") == Named(name=text).name == text


@pytest.mark.parametrize("text", BAD)
def test_control_characters_are_refused_and_shown_by_their_codes(text: str) -> None:
    with pytest.raises(InvalidInput, match="window, name: expected a line of 1 to 200 characters") as refused:
        require_line(text, "window", "name")
    assert str(refused.value).isprintable()
    with pytest.raises(ValidationError):
        Named(name=text)


@pytest.mark.parametrize("text", ["", "x" * 201, "\ud800", 7, None])
def test_what_is_no_line_is_refused(text: object) -> None:
    with pytest.raises(InvalidInput):
        require_line(text, "pass", "name")
