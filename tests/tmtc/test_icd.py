from tmtc.dictionary.icd import format_icd
from tmtc.dictionary.payload import DICTIONARY


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
