"""What of a request does not fit, in words: people do not read regular expressions, nor look for `body.8`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

UUID_PATTERN = r"^[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}$"
TAG_PATTERN = r"^[a-z0-9][a-z0-9-]{0,39}$"
URL_PATTERN = r"^https?://[^\s]+$"
WORD_PATTERN = r"^[^\s,]([^,\x00-\x1f]{0,38}[^\s,])?$"
KEY_PATTERN = r"^[\x21-\x7e]+$"
RUN_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9=._,+-]{0,99}$"
ASSET_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
SECRET_PATTERN = r"^hss_[A-Za-z0-9_-]{43}$"
NUMBER_PATTERN = r"^[0-9]{1,18}$"
EXAMPLE_ID = "3f0c1a52-8f5d-4c3b-9a51-0d6f0c1d2e3f"

IN_WORDS = {
    UUID_PATTERN: f"must be an id (a UUID in lower case), such as {EXAMPLE_ID}",
    TAG_PATTERN: "must be 1 to 40 lower-case letters, digits and hyphens, the first no hyphen",
    URL_PATTERN: "must be a URL that begins with http:// or https://, without blanks",
    WORD_PATTERN: "must be 1 to 40 characters without commas, the first and the last no blank",
    KEY_PATTERN: "must be letters, digits and signs of ASCII, without blanks",
    RUN_PATTERN: "must be 1 to 100 letters, digits and signs of =._,+-, the first a letter or a digit",
    ASSET_PATTERN: "must be the name of a file of the results, such as trajectory.tum",
    SECRET_PATTERN: "must be the secret of a link: hss_ and 43 letters, digits, hyphens and underscores",
    NUMBER_PATTERN: "must be a whole number of 1 to 18 digits",
}
"""Each pattern of the API as what it asks for."""
_NO_OBJECT = ("model_attributes_type", "model_type", "dict_type")


def in_words(error: Mapping[str, Any]) -> tuple[list[str], str]:
    """Where an error of validation is, and what is wrong there, of one of those that pydantic and FastAPI list."""
    where, context = [str(part) for part in error["loc"]], error.get("ctx", {})
    if error["type"] == "json_invalid" and len(where) > 1:
        return where[:1], no_json(context.get("error", "it ends too early"), int(where[1]))
    if error["type"] == "string_pattern_mismatch" and context.get("pattern") in IN_WORDS:
        return where, IN_WORDS[context["pattern"]]
    if error["type"] in _NO_OBJECT and where == ["body"]:
        return where, "must be an object of JSON, sent with Content-Type: application/json"
    return where, str(error["msg"])


def no_json(reason: str, at: int) -> str:
    """What is wrong with a text that is no JSON; `at` is the character, from 0, at which that shows."""
    return f"is no valid JSON: {reason[:1].lower()}{reason[1:]} at character {at + 1}"
