"""Parameters of a pass: those of our housekeeping, and those of packets that the mission description defines."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from ground_service.errors import EvaluationError, InvalidInput, NotFound
from ground_service.ground import Ground
from ground_service.missions import store as missions
from ground_service.missions.definitions import DeclaredPackets, PacketDefinitions, packet_definitions
from ground_service.missions.timekeeping.core import utc_ns_of_ticks
from ground_service.passes import sample_store, store
from ground_service.passes.model import ExportFormat, PacketInfo, ParameterInfo, PassParameters
from ground_service.passes.series import PARAMETERS, STATE_VALUES, SampleSource, kind_samples
from ground_service.passes.span import PassSpan, pass_span
from ground_service.store.vehicles import find_vehicle
from ground_service.telemetry import rollups
from ground_service.telemetry import values as declared_values
from lunar.arrays import IntArray
from lunar.timescales import ticks_from_utc_ns, utc_texts
from tmtc.dictionary.fields import Field
from tmtc.dictionary.payload import DICTIONARY, STRUCTURES
from tmtc.dictionary.schema import PacketDefinition
from tmtc.export import Record, format_records, packet_records
from tmtc.packets.stream import cut_packets, whole_packets
from tmtc.xtce.series import SeriesValue, format_xtce_records, xtce_records

OWN_PACKET = "housekeeping"
PACKET_FIELDS = {
    field.name: (one, field)
    for one in STRUCTURES.values()
    for field in one.fields[1:]
    if one.name != OWN_PACKET and field.size == 1
}
"""Packet and field of the parameters that are read from stored packets: of further housekeeping structures."""

STATE_PACKET = "navigation_state"
STATE_PARAMETERS = {
    f"{STATE_PACKET}.{estimator}.{value}": (code, value)
    for code, estimator in DICTIONARY.labels(STATE_PACKET, "estimator").items()
    for value in STATE_VALUES
}
"""Code of the estimator and value of the parameters of on-board estimators, by their names in addresses."""

LABELS_LIMIT = 256
"""Largest number of codes of one name that are listed."""

RECORDS_LIMIT = 200_000
"""Largest number of packets in one export."""


@dataclass(frozen=True, slots=True, eq=False)
class DeclaredParameter:
    """Parameter of a container of a definition: the number of the container, and the place of the value in it."""

    name: str
    declared: DeclaredPackets
    container: str
    index: int
    value: SeriesValue

    @property
    def info(self) -> ParameterInfo:
        """The parameter as it is listed."""
        data_type = self.value.type
        return ParameterInfo(
            name=self.name,
            packet=self.container,
            source=self.declared.source.name,
            description=self.value.description,
            unit=data_type.unit,
            labels=_labels(self.value),
            warning=data_type.warning,
            alarm=data_type.alarm,
        )


@dataclass(frozen=True, slots=True, eq=False)
class DeclaredReading:
    """Definition that the values of a vehicle are read with, and its parameters by name."""

    definitions: PacketDefinitions
    decoding: declared_values.Decoding
    parameters: dict[str, DeclaredParameter]


def declared_samples(version: int, container: int, places: Mapping[str, int]) -> SampleSource:
    """Return the values of one container as a source of series; `places` are those of the values by name."""

    def read(connection: Connection, span: PassSpan, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        where = (span.vehicle, version, container, span.start_ticks, span.stop_ticks)
        ticks, values = declared_values.read_values(connection, *where, [places[name] for name in names])
        return {"ticks": ticks, **{name: values[:, k] for k, name in enumerate(names)}}

    return SampleSource(rollups.PARAMETERS_CODE, version, container, places, read)


def packet_samples(packet: PacketDefinition, field: str, version: int) -> SampleSource:
    """Return the values of one field of a packet, read from the stored packets, without roll-ups."""

    def read(connection: Connection, span: PassSpan, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        ticks, values = sample_store.packet_values(connection, span, packet, field)
        return {"ticks": ticks, **dict.fromkeys(names, values)}

    return SampleSource(rollups.PACKETS_CODE, version, 0, {}, read)


def pass_parameters(ground: Ground, pass_id: int) -> PassParameters:
    with ground.database.reading() as connection:
        record = store.get_pass(connection, pass_id)
        span = pass_span(connection, record)
        found = declared_reading(connection, record.vehicle_id)
        if found is None:
            return PassParameters(parameters=own_parameters(), packets=(), outcomes={})
        packets = []
        for declared in found.definitions.declared:
            own_span = span_of(span, declared)
            for name, number in declared.numbers.items():
                count = declared_values.count_values(
                    connection,
                    span.vehicle,
                    found.decoding.definition_id,
                    number,
                    own_span.start_ticks,
                    own_span.stop_ticks,
                )
                packets.append(PacketInfo(packet=name, source=declared.source.name, packets=count))
    listed = (one.info for one in found.parameters.values())
    return PassParameters(
        parameters=(*own_parameters(), *listed), packets=tuple(packets), outcomes=found.decoding.counts
    )


def spacecraft_parameters(ground: Ground, spacecraft_id: int, instance: str) -> list[ParameterInfo]:
    """Return the parameters of a spacecraft with series, those of its mission description last."""
    with ground.database.reading() as connection:
        found = declared_reading(connection, find_vehicle(connection, spacecraft_id, instance).id)
    declared = () if found is None else found.parameters.values()
    return [*own_parameters(), *(one.info for one in declared)]


def state_unit(value: str) -> str:
    """Return the unit of a value of an on-board estimator."""
    units = {field.name: field.unit for field in DICTIONARY.packet(STATE_PACKET).fields}
    return units.get(value, "m/s" if "_m_s" in value else "m" if value.endswith("_m") else "")


def own_parameters() -> tuple[ParameterInfo, ...]:
    """Return the parameters of our housekeeping and of the on-board estimators."""
    fields = DICTIONARY.packet(OWN_PACKET).fields
    return (
        *(_own_info(field.name, OWN_PACKET, field) for field in fields if field.name in PARAMETERS),
        *(_state_info(name, value) for name, (_, value) in STATE_PARAMETERS.items()),
        *(_own_info(name, packet.name, field) for name, (packet, field) in PACKET_FIELDS.items()),
    )


def _state_info(name: str, value: str) -> ParameterInfo:
    return ParameterInfo(
        name=name,
        packet=STATE_PACKET,
        source="dictionary",
        description=f"{value} of the estimator {name.split('.')[1]}",
        unit=state_unit(value),
        labels={},
        warning=None,
        alarm=None,
    )


def _own_info(name: str, packet: str, field: Field) -> ParameterInfo:
    return ParameterInfo(
        name=name,
        packet=packet,
        source="dictionary",
        description=field.description,
        unit=field.unit,
        labels={str(code): label for code, label in field.labels},
        warning=field.warning,
        alarm=field.alarm,
    )


def declared_reading(connection: Connection, vehicle: int) -> DeclaredReading | None:
    """Return the definition that the values of a vehicle are read with, None without one."""
    decoding = declared_values.readable_decoding(connection, vehicle)
    if decoding is None:
        return None
    mission = missions.get_mission(
        connection, declared_values.mission_of_definition(connection, decoding.definition_id)
    )
    definitions = packet_definitions(mission)
    return DeclaredReading(definitions, decoding, declared_parameters(definitions))


def declared_parameters(definitions: PacketDefinitions) -> dict[str, DeclaredParameter]:
    """Return the parameters of definitions by their names in addresses.

    The name is that of the parameter if only one container has it and our housekeeping does not, else
    ``container.parameter``. A slash in a name becomes a dot.
    """
    found = [
        DeclaredParameter(value.name, declared, container, index, value)
        for declared in definitions.declared
        for container, layout in declared.layouts.items()
        for index, value in enumerate(layout)
    ]
    counts = dict.fromkeys((*PARAMETERS, *PACKET_FIELDS), 1)
    for one in found:
        counts[one.name] = counts.get(one.name, 0) + 1
    named = (
        replace(one, name=(one.name if counts[one.name] == 1 else f"{one.container}.{one.name}").replace("/", "."))
        for one in found
    )
    return {one.name: one for one in named}


def series_source(connection: Connection, span: PassSpan, parameter: str) -> tuple[SampleSource, PassSpan, str, str]:
    """Return the source of the series of a parameter, its span, the name of its value there, and its unit."""
    if parameter in PARAMETERS:
        unit = DICTIONARY.packet(OWN_PACKET).field(parameter).unit
        return kind_samples(OWN_PACKET, span.dictionary_version), span, parameter, unit
    if parameter in STATE_PARAMETERS:
        code, value = STATE_PARAMETERS[parameter]
        source = kind_samples("navigation_states", span.dictionary_version, code)
        return source, span, value, state_unit(value)
    if parameter in PACKET_FIELDS:
        packet, field = PACKET_FIELDS[parameter]
        return packet_samples(packet, field.name, span.dictionary_version), span, parameter, field.unit
    found = declared_reading(connection, span.vehicle)
    one = None if found is None else found.parameters.get(parameter)
    if found is None or one is None:
        known = [*PARAMETERS, *STATE_PARAMETERS, *PACKET_FIELDS, *(() if found is None else found.parameters)]
        near = "".join(f" (nearest: {name})" for name in get_close_matches(parameter[:80], known, 1))
        raise NotFound("parameter", parameter[:80] + near)
    number = one.declared.numbers[one.container]
    declared = declared_samples(found.decoding.definition_id, number, {parameter: one.index})
    return declared, span_of(span, one.declared), parameter, one.value.type.unit


def span_of(span: PassSpan, declared: DeclaredPackets) -> PassSpan:
    """Return a span in the time of declared packets, whose clock may be another one than the correlated one."""
    time = declared.source.time
    if time is None or time.clock == "payload" or not span.correlations:
        return span
    ends = np.array([span.start_ticks, span.stop_ticks], dtype=np.int64)
    start, stop = ticks_from_utc_ns(utc_ns_of_ticks(ends, span.correlations)[0]).tolist()
    return replace(span, start_ticks=start, stop_ticks=stop, correlations=())


def export_packets(ground: Ground, pass_id: int, packet: str, kind: ExportFormat) -> bytes:
    """Return the decoded packets of one kind in a pass as a file, with their UTC.

    Raises
    ------
    NotFound
        There is no such pass or no such packet.
    InvalidInput
        There are more packets than one file may have.
    EvaluationError
        The pass has no such packets.
    """
    with ground.database.reading() as connection:
        span = pass_span(connection, store.get_pass(connection, pass_id))
        is_own = packet in {definition.name for definition in DICTIONARY.telemetry}
        records = (_own_records if is_own else _declared_records)(connection, span, packet)
    if not records:
        raise EvaluationError(f"pass {pass_id}: expected packets {packet[:80]!r}, found none")
    return format_records(records, kind) if is_own else format_xtce_records(records, kind)


def _declared_records(connection: Connection, span: PassSpan, packet: str) -> list[Record]:
    """Return the packets of a container that the mission description defines, with their UTC."""
    found = declared_reading(connection, span.vehicle)
    declared = None
    if found is not None:
        declared = next((one for one in found.definitions.declared if packet in one.layouts), None)
    if found is None or declared is None or declared.decoder is None:
        raise NotFound("packet", packet[:80])
    span = span_of(span, declared)
    ticks, packets = declared_values.packets_of_container(
        connection,
        span.vehicle,
        found.decoding.definition_id,
        declared.numbers[packet],
        span.start_ticks,
        span.stop_ticks,
        RECORDS_LIMIT + 1,
    )
    if len(ticks) > RECORDS_LIMIT:
        raise InvalidInput("packets", packet, f"at most {RECORDS_LIMIT} in a pass", "more")
    cut = whole_packets(np.array([len(octets) for octets in packets.octets], dtype=np.int64))
    records = xtce_records(declared.decoder.decode(b"".join(packets.octets), cut))
    return _timed(utc_ns_of_ticks(ticks, span.correlations)[0], records)


def packets_by_name(connection: Connection, span: PassSpan) -> Iterator[tuple[str, bool, list[Record]]]:
    """Yield the packets of each kind in a pass: name, whether the dictionary has it, and the records with their UTC."""
    for definition in DICTIONARY.telemetry:
        if records := _own_records(connection, span, definition.name):
            yield definition.name, True, records
    found = declared_reading(connection, span.vehicle)
    for declared in () if found is None else found.definitions.declared:
        for name in declared.layouts if declared.decoder is not None else ():
            if records := _declared_records(connection, span, name):
                yield name, False, records


def _own_records(connection: Connection, span: PassSpan, packet: str) -> list[Record]:
    octets = sample_store.packet_octets(connection, span, DICTIONARY.packet(packet).apid)
    tables = DICTIONARY.unpack_many(octets, cut_packets(octets))
    records = packet_records({packet: tables[packet]} if packet in tables else {})
    if len(records) > RECORDS_LIMIT:
        raise InvalidInput("packets", packet, f"at most {RECORDS_LIMIT} in a pass", str(len(records)))
    return _timed(span.utc_ns([one["ticks"] for one in records]), records)


def _timed(utc_ns: IntArray, records: list[Record]) -> list[Record]:
    return [{"utc": text, **one} for text, one in zip(utc_texts(utc_ns), records, strict=True)]


def _labels(value: SeriesValue) -> dict[str, str]:
    if value.type.is_boolean:
        return {"0": "false", "1": "true"}
    return {
        str(code): label
        for first, last, label in value.type.labels
        if last - first < LABELS_LIMIT
        for code in range(first, last + 1)
    }
