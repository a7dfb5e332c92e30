from pathlib import Path

from tmtc.dictionary import DICTIONARY
from tmtc.icd import format_icd

ROOT = Path(__file__).resolve().parents[2]


def test_the_document_in_the_project_is_the_current_one():
    # `linna tm icd --out docs/icd.md` brings it up to date
    # its second part, about the payload itself, is tested with that
    assert (ROOT / "docs" / "icd.md").read_text(encoding="utf-8").startswith(format_icd())


def test_every_packet_field_and_label_is_in_the_document():
    text = format_icd()
    for definition in DICTIONARY.telemetry + DICTIONARY.telecommands:
        assert f"### {definition.name}\n" in text
        for field in definition.fields + (definition.group.fields if definition.group else ()):
            assert f"| {field.name} |" in text
            assert all(f"| {code} | {label} |" in text for code, label in field.labels)


def test_enumerations_of_one_name_are_the_same_everywhere():
    # the document lists each enumeration once
    seen = {}
    for definition in DICTIONARY.telemetry + DICTIONARY.telecommands:
        for field in definition.fields:
            if field.labels:
                assert seen.setdefault(field.name, field.labels) == field.labels
