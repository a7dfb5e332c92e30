"""The dictionary as XTCE 1.2, and the configuration of Yamcs, for exchange with other ground systems.

Repeated items are an array whose size is the count in the packet, of aggregates, or of numbers if an item is one
number; repeated octets are one binary parameter. Some decoders do not support arrays: for these, the unrolled form
states every item as a parameter, in a container that inherits from that of the item before if the count says so, and
the checksum in a container that inherits when no more items come. A code that means "not known" has no expression in
XTCE: it is calibrated like any other and named in the description.

References
----------
OMG XTCE 1.2, namespace http://www.omg.org/spec/XTCE/20180204; CCSDS 660.0-B-2.
"""

import xml.etree.ElementTree as ET
from dataclasses import replace

from tmtc.dictionary.fields import PARAMETERS, Field
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Dictionary, PacketDefinition

NAMESPACE = "http://www.omg.org/spec/XTCE/20180204"
SCHEMA_LOCATION = f"{NAMESPACE} https://www.omg.org/spec/XTCE/20180204/SpaceSystem.xsd"

_PRIMARY = (
    ("VERSION", 3, "Packet version number"),
    ("TYPE", 1, "Packet type, 0 telemetry"),
    ("SEC_HDR_FLG", 1, "Secondary header flag"),
    ("PKT_APID", 11, "Application process identifier"),
    ("SEQ_FLGS", 2, "Sequence flags"),
    ("SRC_SEQ_CTR", 14, "Sequence count"),
    ("PKT_LEN", 16, "Octets of the data field minus one"),
)
_SECONDARY = (
    ("PUS_VERSION", 4, "PUS version number"),
    ("TIME_STATUS", 4, "Spacecraft time reference status"),
    ("SERVICE", 8, "Service type"),
    ("SUBTYPE", 8, "Service subtype"),
    ("MESSAGE_COUNTER", 16, "Message type counter"),
    ("DESTINATION", 16, "Destination"),
    ("TIME_P_FIELD", 8, "P-field of the CUC time"),
    ("TIME_COARSE", 32, "On-board time, seconds since 2000-01-01T00:00:00 TAI"),
    ("TIME_FINE", 16, "On-board time, units of 2^-16 s"),
)
_CHECKSUM = ("ERROR_CONTROL", 16, "CRC-16 of the packet")


def format_xtce(dictionary: Dictionary = DICTIONARY, *, unrolled: bool = False) -> str:
    """Return the XTCE document; `unrolled`: without arrays, which makes it about thirty times as long."""
    root = ET.Element(
        "SpaceSystem",
        {
            "name": "LINNA",
            "shortDescription": f"LINNA payload, packet dictionary version {dictionary.version}",
            "xmlns": NAMESPACE,
            "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
            "xsi:schemaLocation": SCHEMA_LOCATION,
        },
    )
    ET.SubElement(root, "LongDescription").text = f"Dictionary hash (SHA-256): {dictionary.hash}"
    ET.SubElement(root, "Header", {"version": str(dictionary.version), "validationStatus": "Released"})
    _telemetry(root, dictionary, unrolled)
    _commands(root, dictionary)
    ET.indent(root, "  ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def parameter_name(packet: str, field_name: str, index: int | None = None) -> str:
    """Name of a field's parameter; `index` counts from 1 in vectors and among repeated items."""
    return f"{packet}_{field_name}" if index is None else f"{packet}_{field_name}_{index}"


def _telemetry(root: ET.Element, dictionary: Dictionary, unrolled: bool) -> None:
    metadata = ET.SubElement(root, "TelemetryMetaData")
    types = ET.SubElement(metadata, "ParameterTypeSet")
    parameters = ET.SubElement(metadata, "ParameterSet")
    containers = ET.SubElement(metadata, "ContainerSet")

    for name, bits, description in (*_PRIMARY, *_SECONDARY, _CHECKSUM):
        _unsigned_type(types, f"{name}_Type", bits)
        _parameter(parameters, name, f"{name}_Type", description)
    base = _container(containers, "CCSDSPacket", "Every space packet", abstract=True)
    _entries(base, [name for name, _, _ in _PRIMARY])
    pus = _container(containers, "PUSTelemetry", "Every PUS-C telemetry packet", abstract=True)
    _entries(pus, [name for name, _, _ in _SECONDARY])
    _inherit(pus, "CCSDSPacket", [("VERSION", "==", 0), ("TYPE", "==", 0), ("SEC_HDR_FLG", "==", 1)])

    for d in dictionary.telemetry:
        names = []
        for f in d.fields:
            names += _define(types, parameters, d.name, f)
        conditions = [("PKT_APID", "==", d.apid), ("SERVICE", "==", d.service), ("SUBTYPE", "==", d.subtype)]
        container = _container(containers, d.name, d.description, abstract=False)
        if d.group is None:
            _entries(container, [*names, "ERROR_CONTROL"])
        elif _is_octets(d):
            binary = parameter_name(d.name, d.group.name)
            _binary_type(types, f"{binary}_Type", parameter_name(d.name, d.group.count))
            _parameter(parameters, binary, f"{binary}_Type", "The octets")
            _entries(container, [*names, binary, "ERROR_CONTROL"])
        elif unrolled:
            _entries(container, names)
        else:
            _entries(container, [*names, _array(types, parameters, d), "ERROR_CONTROL"])
        _inherit(container, "PUSTelemetry", conditions)
        if unrolled and d.group is not None and not _is_octets(d):
            _unrolled(types, parameters, containers, d)


def _array(types: ET.Element, parameters: ET.Element, d: PacketDefinition) -> str:
    """Add the array of the repeated items of a packet; return the name of its parameter."""
    assert d.group is not None
    name = parameter_name(d.name, d.group.name)
    for f in d.group.fields:
        _parameter_type(types, _type_name(d.name, f), f)
    item = _type_name(d.name, d.group.fields[0])
    if len(d.group.fields) > 1:
        item = f"{name}_Item_Type"
        members = ET.SubElement(ET.SubElement(types, "AggregateParameterType", {"name": item}), "MemberList")
        for f in d.group.fields:
            given = {"name": f.name, "typeRef": _type_name(d.name, f), "shortDescription": _description(f)}
            ET.SubElement(members, "Member", given)
    array = ET.SubElement(types, "ArrayParameterType", {"name": f"{name}_Type", "arrayTypeRef": item})
    dimension = ET.SubElement(ET.SubElement(array, "DimensionList"), "Dimension")
    ET.SubElement(ET.SubElement(dimension, "StartingIndex"), "FixedValue").text = "0"
    last = ET.SubElement(ET.SubElement(dimension, "EndingIndex"), "DynamicValue")
    count = {"parameterRef": parameter_name(d.name, d.group.count), "useCalibratedValue": "false"}
    ET.SubElement(last, "ParameterInstanceRef", count)
    ET.SubElement(last, "LinearAdjustment", {"slope": "1", "intercept": "-1"})
    _parameter(parameters, name, f"{name}_Type", f"Repeated items of {d.name}")
    return name


def _unrolled(types: ET.Element, parameters: ET.Element, containers: ET.Element, d: PacketDefinition) -> None:
    """Containers of item 1, 2, ... and of the checksum after each number of items."""
    assert d.group is not None
    count = parameter_name(d.name, d.group.count)
    for f in d.group.fields:
        _parameter_type(types, _type_name(d.name, f), f)
    before = d.name
    most = d.field(d.group.count).raw_limits[1]
    for k in range(most + 1):
        if k:
            item = _container(containers, f"{d.name}_item_{k}", f"Item {k} of {d.name}", abstract=False)
            names = []
            for f in d.group.fields:
                name = parameter_name(d.name, f.name, k)
                _parameter(parameters, name, _type_name(d.name, f), _description(f))
                names.append(name)
            _entries(item, names)
            _inherit(item, before, [(count, ">=", k)])
            before = f"{d.name}_item_{k}"
        end = _container(containers, f"{d.name}_end_{k}", f"End of {d.name} after {k} items", abstract=False)
        _entries(end, ["ERROR_CONTROL"])
        _inherit(end, before, [(count, "==", k)])


def _define(types: ET.Element, parameters: ET.Element, packet: str, f: Field) -> list[str]:
    """The type and the parameters of a field; names of the parameters."""
    type_name = _type_name(packet, f)
    _parameter_type(types, type_name, f)
    indices = [None] if f.size == 1 else range(1, f.size + 1)
    names = [parameter_name(packet, f.name, index) for index in indices]
    for name in names:
        _parameter(parameters, name, type_name, _description(f))
    return names


def _type_name(packet: str, f: Field) -> str:
    return f"{packet}_{f.name}_Type"


def _description(f: Field) -> str:
    return f.description + (f"; raw {f.missing} means not known" if f.missing is not None else "")


def _is_octets(d: PacketDefinition) -> bool:
    return d.group is not None and len(d.group.fields) == 1 and d.group.fields[0].type == "u8"


def _parameter_type(types: ET.Element, name: str, f: Field, what: str = "Parameter") -> None:
    bits = int(f.type[1:])
    if f.labels:
        element = ET.SubElement(types, f"Enumerated{what}Type", {"name": name})
        _units(element, f)
        _encoding(element, f)
        listed = ET.SubElement(element, "EnumerationList")
        for code, label in f.labels:
            ET.SubElement(listed, "Enumeration", {"value": str(code), "label": label})
        return
    if f.is_float or f.is_calibrated:
        size = str(bits if f.is_float else 64)
        element = ET.SubElement(types, f"Float{what}Type", {"name": name, "sizeInBits": size})
    else:
        signed = "true" if f.type[0] == "i" else "false"
        element = ET.SubElement(types, f"Integer{what}Type", {"name": name, "sizeInBits": str(bits), "signed": signed})
    _units(element, f)
    _encoding(element, f)
    if f.minimum is not None or f.maximum is not None:
        bounds = {
            key: _number(value, f)
            for key, value in (("minInclusive", f.minimum), ("maxInclusive", f.maximum))
            if value is not None
        }
        parent = element if what == "Parameter" else ET.SubElement(element, "ValidRangeSet")
        ET.SubElement(parent, "ValidRange", bounds)
    if what == "Parameter" and (f.warning or f.alarm):
        ranges = ET.SubElement(ET.SubElement(element, "DefaultAlarm"), "StaticAlarmRanges")
        for tag, limits in (("WarningRange", f.warning), ("CriticalRange", f.alarm)):
            if limits:
                ET.SubElement(
                    ranges, tag, {"minInclusive": _number(limits[0], f), "maxInclusive": _number(limits[1], f)}
                )


def _number(value: float, f: Field) -> str:
    return repr(float(value)) if f.is_float or f.is_calibrated else str(int(value))


def _units(element: ET.Element, f: Field) -> None:
    units = ET.SubElement(element, "UnitSet")
    if f.unit:
        ET.SubElement(units, "Unit", {"description": f.unit}).text = f.unit


def _encoding(element: ET.Element, f: Field) -> None:
    bits = f.type[1:]
    if f.is_float:
        encoding = ET.SubElement(element, "FloatDataEncoding", {"sizeInBits": bits, "encoding": "IEEE754_1985"})
    else:
        kind = "unsigned" if f.type[0] == "u" else "twosComplement"
        encoding = ET.SubElement(element, "IntegerDataEncoding", {"sizeInBits": bits, "encoding": kind})
    if f.scale != 1.0 or f.offset != 0.0:
        calibrator = ET.SubElement(ET.SubElement(encoding, "DefaultCalibrator"), "PolynomialCalibrator")
        ET.SubElement(calibrator, "Term", {"coefficient": repr(f.offset), "exponent": "0"})
        ET.SubElement(calibrator, "Term", {"coefficient": repr(f.scale), "exponent": "1"})


def _unsigned_type(types: ET.Element, name: str, bits: int) -> None:
    element = ET.SubElement(types, "IntegerParameterType", {"name": name, "sizeInBits": str(bits), "signed": "false"})
    ET.SubElement(element, "UnitSet")
    ET.SubElement(element, "IntegerDataEncoding", {"sizeInBits": str(bits), "encoding": "unsigned"})


def _binary_type(types: ET.Element, name: str, count: str, what: str = "Parameter", item_octets: int = 1) -> None:
    """Octets of as many items as the parameter or argument `count` says."""
    element = ET.SubElement(types, f"Binary{what}Type", {"name": name})
    ET.SubElement(element, "UnitSet")
    size = ET.SubElement(ET.SubElement(element, "BinaryDataEncoding"), "SizeInBits")
    dynamic = ET.SubElement(size, "DynamicValue")
    reference = {f"{what.lower()}Ref": count, "useCalibratedValue": "false"}
    ET.SubElement(dynamic, f"{what}InstanceRef", reference)
    ET.SubElement(dynamic, "LinearAdjustment", {"slope": str(8 * item_octets), "intercept": "0"})


def _parameter(parameters: ET.Element, name: str, type_name: str, description: str) -> None:
    ET.SubElement(
        parameters, "Parameter", {"name": name, "parameterTypeRef": type_name, "shortDescription": description}
    )


def _container(containers: ET.Element, name: str, description: str, *, abstract: bool) -> ET.Element:
    attributes = {"name": name, "shortDescription": description}
    if abstract:
        attributes["abstract"] = "true"
    return ET.SubElement(containers, "SequenceContainer", attributes)


def _entries(container: ET.Element, names: list[str]) -> None:
    entries = ET.SubElement(container, "EntryList")
    for name in names:
        ET.SubElement(entries, "ParameterRefEntry", {"parameterRef": name})


def _inherit(container: ET.Element, base: str, conditions: list[tuple[str, str, int]]) -> None:
    criteria = ET.SubElement(ET.SubElement(container, "BaseContainer", {"containerRef": base}), "RestrictionCriteria")
    parent = criteria if len(conditions) == 1 else ET.SubElement(criteria, "ComparisonList")
    for name, operator, value in conditions:
        ET.SubElement(
            parent,
            "Comparison",
            {"parameterRef": name, "comparisonOperator": operator, "value": str(value), "useCalibratedValue": "false"},
        )


def _commands(root: ET.Element, dictionary: Dictionary) -> None:
    """Commands: header fields that the sender fills in (count, length) are zeros; it appends the checksum.

    On-board parameters are named.
    """
    if not dictionary.telecommands:
        return
    metadata = ET.SubElement(root, "CommandMetaData")
    types = ET.SubElement(metadata, "ArgumentTypeSet")
    commands = ET.SubElement(metadata, "MetaCommandSet")
    for d in dictionary.telecommands:
        command = ET.SubElement(commands, "MetaCommand", {"name": d.name, "shortDescription": d.description})
        arguments = ET.Element("ArgumentList")
        names = []
        for f in d.fields:
            type_name = f"{d.name}_{f.name}_Type"
            if f.name == "parameter_id":
                f = replace(f, labels=tuple((one.number, one.name) for one in PARAMETERS))
            _parameter_type(types, type_name, f, "Argument")
            ET.SubElement(
                arguments, "Argument", {"name": f.name, "argumentTypeRef": type_name, "shortDescription": f.description}
            )
            names.append(f.name)
        if d.group is not None:
            type_name = f"{d.name}_{d.group.name}_Type"
            octets = sum(f.octets for f in d.group.fields)
            _binary_type(types, type_name, d.group.count, "Argument", octets)
            ET.SubElement(arguments, "Argument", {"name": d.group.name, "argumentTypeRef": type_name})
            names.append(d.group.name)
        if names:
            command.append(arguments)
        container = ET.SubElement(command, "CommandContainer", {"name": f"{d.name}_packet"})
        entries = ET.SubElement(container, "EntryList")
        head = d.key >> 16
        header = f"{head:04X}C0000000{0x2F:02X}{d.service:02X}{d.subtype:02X}0000"
        ET.SubElement(
            entries, "FixedValueEntry", {"name": "header", "binaryValue": header, "sizeInBits": str(len(header) * 4)}
        )
        for name in names:
            ET.SubElement(entries, "ArgumentRefEntry", {"argumentRef": name})


_SERVER = """services:
  - class: org.yamcs.http.HttpServer
    args:
      address: 127.0.0.1
      port: 8090
dataDir: data
cacheDir: cache
instances:
  - linna
"""

_PROCESSOR = """realtime:
  services:
    - class: org.yamcs.StreamTmPacketProvider
    - class: org.yamcs.StreamTcCommandReleaser
    - class: org.yamcs.tctm.StreamParameterProvider
    - class: org.yamcs.algorithms.AlgorithmManager
    - class: org.yamcs.parameter.LocalParameterManager
  config:
    subscribeAll: true
    persistParameters: false
Archive:
  services:
    - class: org.yamcs.tctm.ReplayService
"""

_CHANNEL = """      - vcId: {channel}
        ocfPresent: true
        service: PACKET
        maxPacketLength: 65542
        stream: {stream}
        packetPreprocessorClassName: org.yamcs.pus.PusPacketPreprocessor
        packetPreprocessorArgs:
          errorDetection:
            type: CRC-16-CCIIT
          pktTimeOffset: 13
          performTimeCorrelation: false
          timeEncoding:
            type: CUC
            epoch: CUSTOM
            epochUTC: "1999-12-31T23:59:28Z"
            timeIncludesLeapSeconds: true
"""

_INSTANCE = """services:
  - class: org.yamcs.archive.XtceTmRecorder
  - class: org.yamcs.archive.ParameterRecorder
  - class: org.yamcs.archive.AlarmRecorder
  - class: org.yamcs.archive.EventRecorder
  - class: org.yamcs.archive.ReplayServer
  - class: org.yamcs.parameterarchive.ParameterArchive
    args:
      realtimeFiller:
        enabled: true
  - class: org.yamcs.archive.CommandHistoryRecorder
  - class: org.yamcs.ProcessorCreatorService
    args:
      name: realtime
      type: realtime
dataLinks:
  - name: frames
    class: org.yamcs.tctm.ccsds.UdpTmFrameLink
    port: {frame_port}
    frameType: TM
    clcwStream: clcw
    goodFrameStream: good_frames
    badFrameStream: bad_frames
    spacecraftId: {spacecraft_id}
    frameLength: {frame_length}
    errorDetection: {frame_check}
    virtualChannels:
{channels}  - name: telecommands
    class: org.yamcs.tctm.TcpTcDataLink
    host: {host}
    port: {port}
    stream: tc_realtime
    commandPostprocessorClassName: org.yamcs.tctm.pus.PusCommandPostprocessor
    commandPostprocessorArgs:
      errorDetection:
        type: CRC-16-CCIIT
mdb:
  - type: xtce
    args:
      file: mdb/linna.xml
streamConfig:
  tm:
    - name: tm_realtime
      processor: realtime
    - name: tm_dump
  invalidTm: invalid_tm_stream
  cmdHist: [cmdhist_realtime]
  event: [events_realtime]
  param: [pp_realtime, sys_param]
  parameterAlarm: [alarms_realtime]
  eventAlarm: [event_alarms_realtime]
  tc:
    - name: tc_realtime
      processor: realtime
"""


def yamcs_files(
    spacecraft_id: int, frame_length: int, checksum: bool, frame_port: int, telecommands: tuple[str, int]
) -> dict[str, str]:
    """Return the files of the instance by path, relative to the folder in which Yamcs is started.

    Parameters
    ----------
    frame_length, checksum
        Octets of a frame, and whether frames end with a checksum.
    frame_port
        UDP port of the frames.
    telecommands
        Host and TCP port of the station.
    """
    streams = ((0, "tm_realtime"), (1, "tm_dump"))
    instance = _INSTANCE.format(
        spacecraft_id=spacecraft_id,
        frame_length=frame_length,
        frame_check="CRC16" if checksum else "NONE",
        frame_port=frame_port,
        host=telecommands[0],
        port=telecommands[1],
        channels="".join(_CHANNEL.format(channel=channel, stream=stream) for channel, stream in streams),
    )
    return {
        "etc/yamcs.yaml": _SERVER,
        "etc/processor.yaml": _PROCESSOR,
        "etc/yamcs.linna.yaml": instance,
        "mdb/linna.xml": format_xtce(),
    }
