"""XTCE documents as packet definitions: the subset that the decoder supports, all else refused by name.

Types are `Integer`, `Float`, `Enumerated`, `Boolean`, `String`, `Binary`, `AbsoluteTime`, `RelativeTime`, `Array` and
`AggregateParameterType` in nested space systems; containers inherit under comparisons and boolean expressions. Only
what the containers use is read: a type or algorithm that no container needs is not looked at, and neither are
commands. Nothing that could change a value is passed over: alarms that are not read are counted.

References
----------
OMG XTCE 1.2 (CCSDS 660.0-B-2), CCSDS 660.1-G-2; the same elements of XTCE 1.1 and 1.3 are read.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from typing import Literal

from tmtc.errors import DefinitionError
from tmtc.packets.space_packets import PACKET_MAX_LENGTH
from tmtc.xtce.definition import (
    AggregateType,
    AllOf,
    AnyOf,
    ArrayType,
    BinaryEncoding,
    Calibration,
    Calibrator,
    CodeIn,
    Comparison,
    Condition,
    Container,
    DataType,
    Definition,
    Encoding,
    Entry,
    FloatEncoding,
    IntegerEncoding,
    IntegerForm,
    Limits,
    Operator,
    Parameter,
    Polynomial,
    Reference,
    ScalarType,
    Size,
    Spline,
    StringEncoding,
    fixed_bits,
    references,
)
from tmtc.xtce.nodes import Node, parse_xml

MAX_BITS = PACKET_MAX_LENGTH * 8
"""Bits of the longest packet: no size and no position is greater."""
MAX_VALUES = 100_000
"""Values that a type or a container may hold once all that it refers to is written out."""
MAX_INHERITANCE = 2_000
MAX_TYPE_DEPTH = 16
MAX_EXPONENT = 30

_DESCRIPTION = ("LongDescription", "AliasSet", "AncillaryDataSet")
_NAMED = ("name", "shortDescription", "initialValue")
_TYPE_CHILDREN = (
    *_DESCRIPTION, "UnitSet", "ToString", "ValidRange", "ValidRangeSet", "SizeRangeInCharacters", "DefaultAlarm",
    "ContextAlarmList", "BinaryContextAlarmList", "EnumerationList", "IntegerDataEncoding", "FloatDataEncoding",
    "StringDataEncoding", "BinaryDataEncoding",
)  # fmt: skip
_TYPE_ATTRIBUTES = (
    *_NAMED, "baseType", "signed", "sizeInBits", "oneStringValue", "zeroStringValue",
    "restrictionPattern", "characterWidth",
)  # fmt: skip
_ENCODINGS = ("IntegerDataEncoding", "FloatDataEncoding", "StringDataEncoding", "BinaryDataEncoding")
_ENCODINGS_OF_NUMBERS = _ENCODINGS[:2]
_ENCODINGS_OF = {
    "IntegerParameterType": _ENCODINGS_OF_NUMBERS,
    "FloatParameterType": _ENCODINGS_OF_NUMBERS,
    "EnumeratedParameterType": ("IntegerDataEncoding",),
    "BooleanParameterType": _ENCODINGS_OF_NUMBERS,
    "StringParameterType": ("StringDataEncoding",),
    "BinaryParameterType": ("BinaryDataEncoding",),
    "AbsoluteTimeParameterType": _ENCODINGS,
    "RelativeTimeParameterType": _ENCODINGS,
}
_INTEGER_FORMS: dict[str, IntegerForm] = {
    "unsigned": "unsigned",
    "twosComplement": "twosComplement",
    "twosCompliment": "twosComplement",  # so spelt in XTCE 1.0 and 1.1
    "signed": "twosComplement",
    "onesComplement": "onesComplement",
    "signMagnitude": "signMagnitude",
}
_OPERATORS: dict[str, Operator] = {
    "==": "==", "eq": "==", "!=": "!=", "neq": "!=", "<": "<", "lt": "<", "<=": "<=", "leq": "<=", ">": ">", "gt": ">",
    ">=": ">=", "geq": ">=",
}  # fmt: skip
_CHARSETS = {
    "US-ASCII": "ascii", "ISO-8859-1": "latin-1", "Windows-1252": "cp1252", "UTF-8": "utf-8", "UTF-16": "utf-16",
    "UTF-16LE": "utf-16-le", "UTF-16BE": "utf-16-be", "UTF-32": "utf-32", "UTF-32LE": "utf-32-le",
    "UTF-32BE": "utf-32-be",
}  # fmt: skip
_NO_PARAMETER = "_yamcs_ignore"
"""Name that Yamcs gives where the schema asks for a size parameter but the size tag or terminator says it all."""
_OF_YAMCS = (_NO_PARAMETER.encode(), b"Yamcs PyMDB", b'name="Yamcs"')
"""Marks of documents that were made for Yamcs, or by F Prime for it: a size before a text counts octets there, and
splines are extrapolated."""
_TAGGED_OCTETS = re.compile(r"org\.yamcs\.algo\.LeadingSizeBinaryDecoder\((\d+)\)")
_ALARMS = (
    "ChangeAlarmRanges", "AlarmMultiRanges", "AlarmConditions", "CustomAlarm", "EnumerationAlarmList",
    "StringAlarmList", "ContextAlarm",
)  # fmt: skip
_WARNING, _ALARM = ("WarningRange", "WatchRange"), ("CriticalRange", "DistressRange", "SevereRange")

LeadingSize = Literal["octets", "bits"]


def parse_xtce(
    documents: str | bytes | Mapping[str, str | bytes], leading_size: LeadingSize | None = None
) -> Definition:
    """Return what XTCE documents define.

    Parameters
    ----------
    documents
        One document, or several by name; the names appear in errors. References may cross documents.
    leading_size
        What the size before a text counts. By default octets in documents that were made for Yamcs or by F Prime, and
        bits in others: the standard does not name the unit.

    Raises
    ------
    DefinitionError
        A document is damaged, contradicts itself, or uses an element that is not supported: one line that names the
        document, the line, the element, what was expected and what was found.
    """
    if isinstance(documents, (str, bytes)):
        documents = {"XTCE": documents}
    top: list[_System] = []
    of_yamcs = set()
    for name, text in documents.items():
        octets = text.encode() if isinstance(text, str) else text
        if any(mark in octets for mark in _OF_YAMCS):
            of_yamcs.add(name)
        root = parse_xml(text, name)
        if root.tag != "SpaceSystem":
            raise root.error("a SpaceSystem", root.tag)
        system = _system(root, None)
        if any(other.name == system.name for other in top):
            raise root.error("different names of space systems", f"{system.name!r} twice")
        top.append(system)
    return _Importer(top, of_yamcs, leading_size).definition()


@dataclass(slots=True, eq=False)
class _System:
    """A space system: its elements by kind and name."""

    name: str
    path: str
    parent: _System | None
    node: Node
    types: dict[str, Node] = field(default_factory=dict)
    parameters: dict[str, Node] = field(default_factory=dict)
    containers: dict[str, Node] = field(default_factory=dict)
    systems: dict[str, _System] = field(default_factory=dict)


def _system(node: Node, parent: _System | None) -> _System:
    node.only(
        (*_DESCRIPTION, "Header", "TelemetryMetaData", "CommandMetaData", "ServiceSet", "Service", "SpaceSystem"),
        (*_NAMED, "operationalStatus", "ID"),
    )
    name = node.attribute("name")
    system = _System(name, f"{parent.path if parent else ''}/{name}", parent, node)
    metadata = node.child("TelemetryMetaData")
    if metadata is not None:
        sets = ("ParameterTypeSet", "ParameterSet", "ContainerSet")
        metadata.only((*_DESCRIPTION, *sets, "MessageSet", "StreamSet", "AlgorithmSet"))
        for tag, found in zip(sets, (system.types, system.parameters, system.containers), strict=True):
            group = metadata.child(tag)
            for element in group.children if group is not None else ():
                if element.tag == "ParameterRef":
                    continue
                if tag == "ParameterSet":
                    _expect(element, element.tag == "Parameter", "a Parameter", element.tag)
                if tag == "ContainerSet":
                    _expect(element, element.tag == "SequenceContainer", "a SequenceContainer", element.tag)
                key = element.attribute("name")
                _expect(
                    element,
                    key not in found,
                    "a unique name",
                    f"one taken at line {found[key].line if key in found else 0}",
                )
                found[key] = element
    for inner in node.all("SpaceSystem"):
        child = _system(inner, system)
        _expect(inner, child.name not in system.systems, "a unique name", f"a second {child.name!r}")
        system.systems[child.name] = child
    return system


def _expect(node: Node, right: bool, expected: str, found: str) -> None:
    if not right:
        raise node.error(expected, found)


class _Importer:
    """Elements by name as values, each made once."""

    def __init__(self, top: list[_System], of_yamcs: set[str], leading_size: LeadingSize | None) -> None:
        self.top = top
        self.of_yamcs = of_yamcs
        self.leading_size = leading_size
        self.extrapolates = False
        self.size_tags: set[LeadingSize] = set()
        self.alarms_not_read = 0
        self.systems: list[_System] = []
        pending = list(reversed(top))
        while pending:
            system = pending.pop()
            self.systems.append(system)
            pending.extend(reversed(system.systems.values()))
        self.types: dict[int, DataType] = {}
        self.values: dict[int, int] = {}
        self.open: list[Node] = []
        self.parameters: dict[str, Parameter] = {}
        self.names = _column_names([(s.path, name) for s in self.systems for name in s.parameters])
        self.container_names = _column_names([(s.path, name) for s in self.systems for name in s.containers])
        self.owner = {id(node): (s, node) for s in self.systems for node in s.containers.values()}
        self.bases: dict[int, int] = {}
        self.followers: dict[int, list[int]] = {key: [] for key in self.owner}
        self.included: set[int] = set()
        self.parts: dict[int, tuple[Entry, ...]] = {}
        self.sizes: dict[int, int] = {}

    def definition(self) -> Definition:
        """Everything, once every reference holds."""
        owner, bases, followers = self.owner, self.bases, self.followers
        for key, (system, node) in owner.items():
            base = node.child("BaseContainer")
            if base is not None:
                base.only(("RestrictionCriteria",), ("containerRef",))
                _, found = self.find("containers", base.attribute("containerRef"), system, base)
                bases[key] = id(found)
                followers[id(found)].append(key)
        made: dict[int, Container] = {}
        for key in self.children_first():
            made[key] = self.container(key, tuple(made[follower] for follower in followers[key]))
        roots = [key for key in owner if key not in bases and key not in self.included]
        if not roots:
            raise self.top[0].node.error("a container without a base", "none")
        for key in roots:
            _check_order(made[key], owner[key][1].document)
        return Definition(
            name=self.top[0].name,
            roots={made[key].name: made[key] for key in roots},
            parameters={parameter.name: parameter for parameter in self.parameters.values()},
            containers={container.name: container for container in made.values()},
            alarms_not_read=self.alarms_not_read,
            size_tags=" and ".join(sorted(self.size_tags, reverse=True)),
            extrapolates=self.extrapolates,
        )

    def children_first(self) -> list[int]:
        """The containers, those that inherit before their bases, none of them over too many steps."""
        expected, depths = "a base that ends in a container without one", dict[int, int]()
        try:
            order = list(TopologicalSorter(self.followers).static_order())
        except CycleError as error:
            raise self.owner[error.args[1][0]][1].error(expected, "itself") from None
        for key in reversed(order):
            depths[key] = depths[self.bases[key]] + 1 if key in self.bases else 0
            steps = f"more than {MAX_INHERITANCE} steps"
            _expect(self.owner[key][1], depths[key] <= MAX_INHERITANCE, expected, steps)
        return order

    def container(self, key: int, children: tuple[Container, ...]) -> Container:
        """The container of an element, with those that continue it."""
        system, node = self.owner[key]
        node.only(
            (*_DESCRIPTION, "DefaultRateInStream", "RateInStreamSet", "BinaryEncoding", "EntryList", "BaseContainer"),
            (*_NAMED, "abstract", "idlePattern", "sizeInBits"),
        )
        base = node.child("BaseContainer")
        criteria = base.child("RestrictionCriteria") if base is not None else None
        return Container(
            name=self.container_names[system.path, node.attributes["name"]],
            path=f"{system.path}/{node.attributes['name']}",
            entries=self.entries(key),
            abstract=_boolean(node, "abstract", False),
            condition=None if criteria is None else self.condition(criteria, system),
            children=children,
            description=node.attributes.get("shortDescription", ""),
        )

    def entries(self, key: int) -> tuple[Entry, ...]:
        """Entries of a container; those of containers in it are made first."""
        if key in self.parts:
            return self.parts[key]
        system, node = self.owner[key]
        if node in self.open:
            raise node.error("containers that do not contain themselves", f"{node.attributes['name']!r} in itself")
        _expect(node, len(self.open) < MAX_TYPE_DEPTH, f"containers at most {MAX_TYPE_DEPTH} deep", "deeper")
        self.open.append(node)
        found, size = [], 0
        for element in node.required("EntryList").children:
            item: Parameter | Container
            if element.tag == "ContainerRefEntry":
                item, count = self.included_container(element, system)
                reference = "containerRef"
            else:
                item, count = self.parameter_entry(element, system)
                reference = "parameterRef"
            repeat = element.child("RepeatEntry")
            if repeat is not None:
                item = self.repeated(repeat, item, system)
            size += count
            found.append(self.entry(element, item, system, (reference,)))
            _expect(node, size <= MAX_VALUES, f"at most {MAX_VALUES} values", "more")
        self.open.pop()
        self.sizes[key] = size
        self.parts[key] = tuple(found)
        return self.parts[key]

    def included_container(self, element: Node, system: _System) -> tuple[Container, int]:
        """The container of an entry and the number of its values."""
        home, inner = self.find("containers", element.attribute("containerRef"), system, element)
        key, name = id(inner), inner.attributes["name"]
        if key in self.bases or self.followers[key]:
            raise element.error("a container without base and without containers that inherit from it", name)
        self.included.add(key)
        encoding = inner.child("BinaryEncoding")
        size = None if encoding is None else self.size(encoding.required("SizeInBits"), home, least=1)
        _expect(inner, size is None or size.fixed is not None, "a fixed size of a part", "another")
        content = Container(
            self.container_names[home.path, name],
            f"{home.path}/{name}",
            self.entries(key),
            False,
            None,
            (),
            bits=None if size is None else size.fixed,
        )
        return content, self.sizes[key]

    def repeated(self, node: Node, item: Parameter | Container, system: _System) -> Parameter:
        """Return an entry that is repeated, as an array; the repetitions of a container are aggregates."""
        node.only(("Count", "Offset"))
        offset = node.child("Offset")
        gap = 0 if offset is None else self.size(offset, system, least=0).fixed
        if offset is not None and gap is None:
            raise offset.error("a FixedValue between repetitions", offset.children[0].tag)
        count, tail = self.size(node.required("Count"), system, least=0), 0
        if isinstance(item, Container):
            plain = [
                (one.item.name, one.item.type)
                for one in item.entries
                if isinstance(one.item, Parameter) and one == Entry(one.item)
            ]
            _expect(node, len(plain) == len(item.entries), "parameters one after another", "other entries")
            inner, stated = AggregateType(item.name, tuple(plain)), item.bits
            if stated is not None:
                width = fixed_bits(inner)
                _expect(node, width is not None and width <= stated, f"parts of {stated} bits", f"{width or 'others'}")
                tail = stated - (width or 0)
            item = Parameter(item.name, item.path, inner)
        if count.fixed is not None:
            last = replace(count, fixed=count.fixed - 1)
        elif count.lookup:
            last = replace(count, lookup=tuple((condition, value - 1) for condition, value in count.lookup))
        else:
            last = replace(count, intercept=count.intercept - 1)
        return replace(item, type=ArrayType(item.type.name, item.type, Size(fixed=0), last, (gap or 0) + tail, tail))

    # references

    def find(self, kind: str, reference: str, system: _System, node: Node) -> tuple[_System, Node]:
        """The element that a name refers to, seen from a system: `name`, `a/name`, `../name` or `/a/b/name`."""
        *steps, name = reference.split("/")
        if steps and steps[0] == "":
            path = steps[1:]
            if path:
                named = [top for top in self.top if top.name == path[0]]
                found = self._descend(named[0], path[1:], kind, name) if named else None
                if found is not None:
                    return found
            for top in self.top:  # the name of the root may be left out
                found = self._descend(top, path, kind, name)
                if found is not None:
                    return found
        else:
            start: _System | None = system
            while start is not None:
                found = self._descend(start, steps, kind, name)
                if found is not None:
                    return found
                start = start.parent
        what = {"types": "parameter type", "parameters": "parameter", "containers": "container"}[kind]
        raise node.error(f"the name of a {what}", repr(reference))

    def _descend(self, start: _System | None, steps: list[str], kind: str, name: str) -> tuple[_System, Node] | None:
        for step in steps:
            if start is None:
                return None
            if step == "..":
                start = start.parent
            elif step != ".":
                start = start.systems.get(step)
        if start is None or name not in getattr(start, kind):
            return None
        return start, getattr(start, kind)[name]

    def reference(self, node: Node, system: _System) -> tuple[Reference, ScalarType]:
        """Return the parameter that a `parameterRef` names, and its type."""
        instance = node.attributes.get("instance", "0")
        _expect(node, instance == "0", "instance 0, the one of this packet", instance)
        text = node.attribute("parameterRef")
        members: list[str] = []
        while True:
            try:
                owner, found = self.find("parameters", text, system, node)
                break
            except DefinitionError:
                place = max(text.rfind("/"), text.rfind("."))
                if place <= 0:
                    self.find("parameters", node.attribute("parameterRef"), system, node)
                    raise
                members.insert(0, text[place + 1 :])
                text = text[:place]
        _, type_node = self.find("types", found.attribute("parameterTypeRef"), owner, found)
        if any(type_node is opened for opened in self.open):
            return self.own_reference(node, self.names[owner.path, found.attributes["name"]], type_node)
        parameter = self.parameter(owner, found)
        data_type = parameter.type
        for member in members:
            inner = dict(data_type.members).get(member) if isinstance(data_type, AggregateType) else None
            if inner is None:
                raise node.error(f"a member of {data_type.name!r}", repr(member))
            data_type = inner
        if not isinstance(data_type, ScalarType):
            raise node.error("a parameter with one value", f"{data_type.name!r}")
        calibrated = _boolean(node, "useCalibratedValue", True)
        return Reference(parameter.name, tuple(members), calibrated), data_type

    def own_reference(self, node: Node, name: str, type_node: Node) -> tuple[Reference, ScalarType]:
        """A reference to the parameter that is being calibrated: to its raw value, for it has no other yet."""
        encoding = next((child for child in type_node.children if child.tag in _ENCODINGS_OF_NUMBERS), None)
        _expect(node, encoding is not None, "a parameter whose type is another", f"{name!r} itself")
        calibrated = _boolean(node, "useCalibratedValue", True)
        _expect(node, not calibrated, "useCalibratedValue false for the parameter itself", "true")
        assert encoding is not None
        is_float = encoding.tag == "FloatDataEncoding"
        own = ScalarType(type_node.attributes["name"], FloatEncoding(64) if is_float else IntegerEncoding(64))
        return Reference(name, (), False), own

    def parameter(self, system: _System, node: Node) -> Parameter:
        """The parameter of an element."""
        path = f"{system.path}/{node.attributes['name']}"
        if path not in self.parameters:
            node.only((*_DESCRIPTION, "ParameterProperties"), (*_NAMED, "parameterTypeRef"))
            column = self.names[system.path, node.attributes["name"]]
            owner, type_node = self.find("types", node.attribute("parameterTypeRef"), system, node)
            data_type = self.type(owner, type_node)
            self.parameters[path] = Parameter(column, path, data_type, node.attributes.get("shortDescription", ""))
        return self.parameters[path]

    # types

    def type(self, system: _System, node: Node) -> DataType:
        """The type of an element, made once."""
        key = id(node)
        if key not in self.types:
            if node in self.open:
                raise node.error("types that do not contain themselves", f"{node.attributes['name']!r} in itself")
            _expect(node, len(self.open) < MAX_TYPE_DEPTH, f"types at most {MAX_TYPE_DEPTH} deep", "deeper")
            self.open.append(node)
            if node.tag == "ArrayParameterType":
                data_type, values = self.array(system, node)
            elif node.tag == "AggregateParameterType":
                data_type, values = self.aggregate(system, node)
            elif node.tag in _ENCODINGS_OF:
                data_type, values = self.scalar(system, node), 1
            else:
                raise node.error("a parameter type that is supported", f"{node.tag}, which is not")
            _expect(node, values <= MAX_VALUES, f"at most {MAX_VALUES} values", f"{values}")
            self.open.pop()
            self.types[key], self.values[key] = data_type, values
        return self.types[key]

    def array(self, system: _System, node: Node, dimensions: Node | None = None) -> tuple[DataType, int]:
        """An array type; of several dimensions, the last index moves fastest."""
        node.only((*_DESCRIPTION, "DimensionList"), (*_NAMED, "arrayTypeRef", "numberOfDimensions"))
        owner, found = self.find("types", node.attribute("arrayTypeRef"), system, node)
        made = self.type(owner, found)
        dimensions = dimensions if dimensions is not None else node.child("DimensionList")
        if dimensions is None:
            raise node.error("a DimensionList", "none")
        dimensions.only(("Dimension",))
        listed = list(dimensions.all("Dimension"))
        _expect(dimensions, 1 <= len(listed) <= 4, "1 to 4 dimensions", f"{len(listed)}")
        for dimension in reversed(listed):
            dimension.only(("StartingIndex", "EndingIndex"))
            first = self.size(dimension.required("StartingIndex"), system, least=None)
            last = self.size(dimension.required("EndingIndex"), system, least=None)
            if first.fixed is not None and last.fixed is not None:
                count = last.fixed - first.fixed + 1
                _expect(dimension, 0 <= count <= MAX_BITS, f"0 to {MAX_BITS} elements", f"{count}")
            made = ArrayType(node.attributes["name"], made, first, last)
        return made, self.values[id(found)]

    def aggregate(self, system: _System, node: Node) -> tuple[DataType, int]:
        node.only((*_DESCRIPTION, "MemberList"), _NAMED)
        listed = node.required("MemberList")
        listed.only(("Member",))
        members: dict[str, DataType] = {}
        values = 0
        for member in listed.children:
            member.only(_DESCRIPTION, (*_NAMED, "typeRef"))
            name = member.attribute("name")
            _expect(member, name not in members, "a unique name", "a second one")
            owner, found = self.find("types", member.attribute("typeRef"), system, member)
            members[name] = self.type(owner, found)
            values += self.values[id(found)]
            _expect(node, values <= MAX_VALUES, f"at most {MAX_VALUES} values", "more")
        _expect(listed, bool(members), "a member", "none")
        return AggregateType(node.attributes["name"], tuple(members.items())), values

    def scalar(self, system: _System, node: Node) -> ScalarType:
        """A type of one value; what it does not say it has from its base type."""
        chain = [(system, node)]
        while "baseType" in chain[-1][1].attributes:
            here, last = chain[-1]
            chain.append(self.find("types", last.attributes["baseType"], here, last))
            if any(chain[-1][1] is other for _, other in chain[:-1]):
                raise node.error("a base type that is another", f"{last.attributes['baseType']!r} again")
            _expect(node, chain[-1][1].tag == node.tag, f"a base type that is a {node.tag}", chain[-1][1].tag)
        is_time = "Time" in node.tag
        for _, one in chain:
            extra = ("Encoding", "ReferenceTime") if is_time else ()
            one.only((*_TYPE_CHILDREN, *extra), _TYPE_ATTRIBUTES)
        encoding, place, home = None, node, system
        scale: tuple[float, float] | None = None
        for home, one in chain:
            holder = (one.child("Encoding") if is_time else None) or one
            if holder is not one:
                holder.only(_ENCODINGS, ("units", "scale", "offset"))
            found = [child for child in holder.children if child.tag in _ENCODINGS]
            if found:
                _expect(found[-1], len(found) == 1, "one encoding", f"{len(found)}")
                place = found[0]
                _expect(
                    place,
                    place.tag in _ENCODINGS_OF[node.tag],
                    f"one of {', '.join(_ENCODINGS_OF[node.tag])} for a {node.tag}",
                    place.tag,
                )
                if holder is not one and holder.attributes.keys() & {"scale", "offset"}:
                    scale = _number(holder, "scale", 1.0), _number(holder, "offset", 0.0)
                encoding = self.encoding(place, home, scale)
                break
        if encoding is None:
            raise node.error("a data encoding", "none")
        labels = next((listed for _, one in chain if (listed := one.child("EnumerationList")) is not None), None)
        units = next((u for _, one in chain if (u := one.child("UnitSet")) is not None), None)
        time = node.child("ReferenceTime")
        reference = None if time is None else time.child("Epoch")
        self.alarms_not_read += _alarms_not_read(chain)
        return ScalarType(
            name=node.attributes["name"],
            encoding=encoding,
            labels=_labels(node, labels, encoding) if node.tag == "EnumeratedParameterType" else (),
            is_boolean=node.tag == "BooleanParameterType",
            truth=(_stated(chain, "zeroStringValue", "False"), _stated(chain, "oneStringValue", "True")),
            unit=" ".join(u.text for u in units.children) if units is not None else "",
            epoch=reference.text if is_time and reference is not None else "",
            warning=_limits(chain, _WARNING),
            alarm=_limits(chain, _ALARM),
        )

    def encoding(self, node: Node, system: _System, scale: tuple[float, float] | None) -> Encoding:
        """The encoding of an element; `scale` (scale, offset) of a time stands for a calibrator."""
        order = node.attributes.get("bitOrder", "mostSignificantBitFirst")
        _expect(node, order == "mostSignificantBitFirst", "bitOrder mostSignificantBitFirst", order)
        if node.tag == "StringDataEncoding":
            _expect(node, scale is None, "a number where scale and offset are given", "text")
            return self.string(node, system)
        if node.tag == "BinaryDataEncoding":
            _expect(node, scale is None, "a number where scale and offset are given", "octets")
            return self.binary(node, system)
        node.only(
            ("ErrorDetectCorrect", "DefaultCalibrator", "ContextCalibratorList"),
            ("bitOrder", "byteOrder", "encoding", "sizeInBits", "changeThreshold"),
        )
        calibration = self.calibration(node, system)
        if scale is not None:
            _expect(node, calibration == Calibration(), "scale and offset or a calibrator", "both")
            calibration = Calibration(Polynomial(((scale[1], 0), (scale[0], 1))))
        if node.tag == "IntegerDataEncoding":
            bits = _integer(node, "sizeInBits", 8)
            _expect(node, 1 <= bits <= 64, "sizeInBits of 1 to 64", f"{bits}")
            form = node.attributes.get("encoding", "unsigned")
            _expect(node, form in _INTEGER_FORMS, f"encoding {', '.join(_INTEGER_FORMS)}", form)
            little = _is_little(node, bits)
            _expect(node, not little or bits % 8 == 0, "whole octets where the least comes first", f"{bits} bits")
            return IntegerEncoding(bits, _INTEGER_FORMS[form], little, calibration)
        bits = _integer(node, "sizeInBits", 32)
        form = node.attributes.get("encoding", "IEEE754_1985")
        form = {"IEEE-754": "IEEE754", "MIL-1750A": "MILSTD_1750A"}.get(form, form)  # so spelt in older documents
        if form in ("IEEE754", "IEEE754_1985"):
            _expect(node, bits in (16, 32, 64), "sizeInBits 16, 32 or 64", f"{bits}")
            return FloatEncoding(bits, "IEEE754", _is_little(node, bits), calibration)
        _expect(node, form == "MILSTD_1750A", "encoding IEEE754, IEEE754_1985 or MILSTD_1750A", form)
        _expect(node, bits in (32, 48), "sizeInBits 32 or 48", f"{bits}")
        return FloatEncoding(bits, "MILSTD_1750A", _is_little(node, bits), calibration)

    def binary(self, node: Node, system: _System) -> BinaryEncoding:
        """Return the encoding of octets; of the algorithms, only a size in octets before them is supported."""
        children = ("SizeInBits", "FromBinaryTransformAlgorithm", "ToBinaryTransformAlgorithm")
        node.only((*children, "ErrorDetectCorrect"), ("bitOrder", "byteOrder"))
        _expect(node, not _is_little(node, 8), "octets in their order", "leastSignificantByteFirst")
        algorithm = node.child(children[1])
        if algorithm is None:
            return BinaryEncoding(self.size(node.required("SizeInBits"), system, least=1))
        text = algorithm.child("AlgorithmText")
        tagged = None if text is None else _TAGGED_OCTETS.fullmatch(text.text)
        tag_bits = 0 if tagged is None else int(tagged[1])
        _expect(algorithm, 1 <= tag_bits <= 32, "elements that are supported here", f"{algorithm.tag}, which is not")
        return BinaryEncoding(Size(), tag_bits)

    def string(self, node: Node, system: _System) -> StringEncoding:
        """A text: its buffer, and what says where the text ends in it."""
        node.only(("SizeInBits", "Variable", "ErrorDetectCorrect"), ("bitOrder", "byteOrder", "encoding"))
        name = node.attributes.get("encoding", "UTF-8")
        _expect(node, name in _CHARSETS, f"encoding {', '.join(_CHARSETS)}", name)
        charset = _CHARSETS[name]
        if charset in ("utf-16", "utf-32"):
            order = node.attribute("byteOrder")
            ends = {"mostSignificantByteFirst": "-be", "leastSignificantByteFirst": "-le"}
            _expect(node, order in ends, f"byteOrder {' or '.join(ends)}", order)
            charset += ends[order]
        fixed, variable = node.child("SizeInBits"), node.child("Variable")
        holder = fixed if fixed is not None else variable
        if holder is None or (fixed is not None and variable is not None):
            raise node.error("either SizeInBits or Variable", "both" if holder is not None else "neither")
        end, tag = holder.child("TerminationChar"), holder.child("LeadingSize")
        size: Size | None = None
        most: int | None = None
        if fixed is not None:
            fixed.only(("Fixed", "TerminationChar", "LeadingSize"))
            value = fixed.child("Fixed")
            if value is not None:
                value.only(("FixedValue",))
                size = Size(fixed=_fixed(value.required("FixedValue"), 1))
        else:
            holder.only(("DynamicValue", "DiscreteLookupList", "TerminationChar", "LeadingSize"), ("maxSizeInBits",))
            most = min(_integer(holder, "maxSizeInBits", MAX_BITS), MAX_BITS)
            dynamic = holder.child("DynamicValue")
            name_of = dynamic.required("ParameterInstanceRef") if dynamic is not None else None
            if name_of is None or name_of.attributes.get("parameterRef") != _NO_PARAMETER:
                size = self.size(holder, system, 0, ("TerminationChar", "LeadingSize"), ("maxSizeInBits",))
        terminator, tag_bits, unit = b"", 0, 1
        if end is not None:
            try:
                terminator = bytes.fromhex(end.text or "00")
            except ValueError:
                raise end.error("hexadecimal digits", repr(end.text)) from None
            try:
                character = terminator.decode(charset)
            except UnicodeDecodeError:
                character = ""
            _expect(end, len(character) == 1, f"one character of {name}", repr(end.text))
        if tag is not None:
            tag.only((), ("sizeInBitsOfSizeTag",))
            tag_bits = _integer(tag, "sizeInBitsOfSizeTag", 16)
            _expect(tag, 1 <= tag_bits <= 32, "sizeInBitsOfSizeTag of 1 to 32", f"{tag_bits}")
            counted = self.leading_size or ("octets" if node.document in self.of_yamcs else "bits")
            self.size_tags.add(counted)
            unit = 8 if counted == "octets" else 1
        _expect(holder, size is not None or end is not None or tag is not None, "a size of the text", "none")
        return StringEncoding(charset, size, terminator, tag_bits, most, unit)

    def size(
        self,
        node: Node,
        system: _System,
        least: int | None,
        others: tuple[str, ...] = (),
        attributes: tuple[str, ...] = (),
    ) -> Size:
        """A fixed or dynamic number; a fixed one is not below `least`."""
        kinds = ("FixedValue", "DynamicValue", "DiscreteLookupList")
        node.only((*kinds, *others), attributes)
        listed = [child for child in node.children if child.tag in kinds]
        _expect(node, len(listed) == 1, f"one of {', '.join(kinds)}", f"{len(listed)}")
        value = listed[0]
        if value.tag == "FixedValue":
            return Size(fixed=_fixed(value, least))
        if value.tag == "DynamicValue":
            value.only(("ParameterInstanceRef", "LinearAdjustment"))
            instance = value.required("ParameterInstanceRef")
            instance.only((), ("parameterRef", "useCalibratedValue", "instance"))
            reference, data_type = self.reference(instance, system)
            numeric = isinstance(data_type.encoding, (IntegerEncoding, FloatEncoding))
            named = (data_type.labels or data_type.is_boolean) and reference.calibrated
            _expect(instance, numeric and not named, "a number", f"{data_type.name!r}")
            adjustment = value.child("LinearAdjustment")
            if adjustment is None:
                return Size(reference=reference)
            adjustment.only((), ("slope", "intercept"))
            slope, intercept = _number(adjustment, "slope", 1.0), _number(adjustment, "intercept", 0.0)
            return Size(reference=reference, slope=slope, intercept=intercept)
        lookup = []
        for one in value.children:
            _expect(one, one.tag == "DiscreteLookup", "a DiscreteLookup", one.tag)
            number = _integer(one, "value", None)
            _expect(one, least is None or least <= number <= MAX_BITS, f"a value of {least} to {MAX_BITS}", f"{number}")
            lookup.append((self.condition(one, system, ("value",)), number))
        _expect(value, bool(lookup), "a DiscreteLookup", "none")
        return Size(lookup=tuple(lookup))

    # calibrators

    def calibration(self, node: Node, system: _System) -> Calibration:
        default = node.child("DefaultCalibrator")
        contexts = []
        listed = node.child("ContextCalibratorList")
        for context in listed.children if listed is not None else ():
            context.only(("ContextMatch", "Calibrator"))
            condition = self.condition(context.required("ContextMatch"), system)
            contexts.append((condition, self.calibrator(context.required("Calibrator"))))
        return Calibration(None if default is None else self.calibrator(default), tuple(contexts))

    def calibrator(self, node: Node) -> Calibrator:
        is_default = node.document in self.of_yamcs
        made = _calibrator(node, is_default)
        self.extrapolates |= is_default and isinstance(made, Spline)
        return made

    # conditions

    def condition(self, node: Node, system: _System, attributes: tuple[str, ...] = ()) -> Condition:
        """The condition that an element holds; all comparisons of a list must hold."""
        kinds = ("Comparison", "ComparisonList", "BooleanExpression")
        node.only(kinds, attributes)
        _expect(node, len(node.children) == 1, f"one of {', '.join(kinds)}", f"{len(node.children)}")
        inner = node.children[0]
        if inner.tag == "Comparison":
            return self.comparison(inner, system)
        if inner.tag == "ComparisonList":
            inner.only(("Comparison",))
            _expect(inner, bool(inner.children), "a Comparison", "none")
            return AllOf(tuple(self.comparison(one, system) for one in inner.children))
        inner.only(("Condition", "ANDedConditions", "ORedConditions"))
        _expect(inner, len(inner.children) == 1, "one condition", f"{len(inner.children)}")
        return self.expression(inner.children[0], system)

    def expression(self, node: Node, system: _System) -> Condition:
        if node.tag != "Condition":
            node.only(("Condition", "ANDedConditions", "ORedConditions"))
            _expect(node, bool(node.children), "a condition", "none")
            parts = tuple(self.expression(one, system) for one in node.children)
            return AllOf(parts) if node.tag == "ANDedConditions" else AnyOf(parts)
        node.only(("ParameterInstanceRef", "ComparisonOperator", "Value"))
        references = list(node.all("ParameterInstanceRef"))
        for one in references:
            one.only((), ("parameterRef", "useCalibratedValue", "instance"))
        operator = node.required("ComparisonOperator")
        value = node.child("Value")
        given = len(references) + (value is not None)
        _expect(node, given == 2 and bool(references), "two sides, the first a parameter", f"{given} sides")
        left, left_type = self.reference(references[0], system)
        if value is not None:
            return _compared(node, left, left_type, operator.text, value.text)
        right, right_type = self.reference(references[1], system)
        for side, data_type in ((left, left_type), (right, right_type)):
            plain = not (data_type.labels or data_type.is_boolean) or not side.calibrated
            number = isinstance(data_type.encoding, (IntegerEncoding, FloatEncoding)) and plain
            _expect(node, number, "numbers on both sides", f"{data_type.name!r}")
        return Comparison(left, _operator(node, operator.text), right)

    def comparison(self, node: Node, system: _System) -> Condition:
        node.only((), ("parameterRef", "useCalibratedValue", "instance", "value", "comparisonOperator"))
        reference, data_type = self.reference(node, system)
        operator = node.attributes.get("comparisonOperator", "==")
        return _compared(node, reference, data_type, operator, node.attribute("value"))

    # entries

    def parameter_entry(self, node: Node, system: _System) -> tuple[Parameter, int]:
        """The parameter of an entry and the number of its values."""
        tags = ("ParameterRefEntry", "ArrayParameterRefEntry", "ContainerRefEntry")
        _expect(node, node.tag in tags, f"an entry that is supported ({', '.join(tags)})", node.tag)
        owner, found = self.find("parameters", node.attribute("parameterRef"), system, node)
        parameter = self.parameter(owner, found)
        type_owner, type_node = self.find("types", found.attribute("parameterTypeRef"), owner, found)
        dimensions = node.child("DimensionList")
        if node.tag == "ArrayParameterRefEntry":
            _expect(node, isinstance(parameter.type, ArrayType), "an array", f"{parameter.type.name!r}")
            if dimensions is not None:
                array, _ = self.array(type_owner, type_node, dimensions)
                parameter = Parameter(parameter.name, parameter.path, array, parameter.description)
        return parameter, self.values[id(type_node)]

    def entry(self, node: Node, item: Parameter | Container, system: _System, attributes: tuple[str, ...]) -> Entry:
        """The entry: where it begins and whether it is there."""
        extra = ("DimensionList",) if node.tag == "ArrayParameterRefEntry" else ()
        children = ("LocationInContainerInBits", "RepeatEntry", "IncludeCondition", "TimeAssociation")
        node.only(
            (*_DESCRIPTION, *children, *extra), (*attributes, "shortDescription", "lastEntryForThisArrayInstance")
        )
        location, condition = node.child("LocationInContainerInBits"), node.child("IncludeCondition")
        offset: int | Size = 0
        from_start = False
        if location is not None:
            where = location.attributes.get("referenceLocation", "previousEntry")
            places = ("previousEntry", "containerStart")
            _expect(location, where in places, f"referenceLocation {' or '.join(places)}", where)
            from_start = where == "containerStart"
            place = self.size(location, system, 0 if from_start else None, attributes=("referenceLocation",))
            offset = place if place.fixed is None else place.fixed
        return Entry(item, offset, from_start, None if condition is None else self.condition(condition, system))


def _column_names(elements: list[tuple[str, str]]) -> dict[tuple[str, str], str]:
    """Names for (path of the system, name): the name alone where there is one of it."""
    counts: dict[str, int] = {}
    for _, name in elements:
        counts[name] = counts.get(name, 0) + 1
    return {(path, name): name if counts[name] == 1 else f"{path}/{name}" for path, name in elements}


def _check_order(root: Container, document: str) -> None:
    """Refuse references to parameters that no packet holds before them."""
    pending: list[tuple[Container, dict[str, bool]]] = [(root, {})]
    while pending:
        container, known = pending.pop()
        names = dict(known)
        place = f"{document}, container {container.path}"
        if container.condition is not None:
            _check_known(references(container.condition), names, place)
        _check_entries(container.entries, names, place)
        pending.extend((child, names) for child in container.children)


def _check_entries(entries: tuple[Entry, ...], names: dict[str, bool], place: str) -> None:
    """Add the parameters of entries to `names`, with whether they have one value; refuse references to others."""
    for entry in entries:
        _check_known(references(entry.offset), names, place)
        if entry.condition is not None:
            _check_known(references(entry.condition), names, place)
            twice = sorted(_names_of(entry.item) & names.keys())
            if twice:
                raise DefinitionError(
                    f"{place}: expected a parameter once where it is under a condition, found {twice[0]!r} again"
                )
        if isinstance(entry.item, Container):
            _check_entries(entry.item.entries, names, place)
        else:
            _check_known(references(entry.item.type) - {entry.item.name}, names, place)
            names[entry.item.name] = not isinstance(entry.item.type, ArrayType)


def _names_of(item: Parameter | Container) -> set[str]:
    if isinstance(item, Parameter):
        return {item.name}
    return set().union(*(_names_of(entry.item) for entry in item.entries))


def _check_known(wanted: set[str], names: Mapping[str, bool], place: str) -> None:
    missing = sorted(name for name in wanted if not names.get(name))
    if missing:
        raise DefinitionError(f"{place}: expected references to parameters that stand before, found {missing[0]!r}")


def _operator(node: Node, text: str) -> Operator:
    _expect(node, text in _OPERATORS, f"an operator ({', '.join(_OPERATORS)})", repr(text))
    return _OPERATORS[text]


def _compared(node: Node, left: Reference, data_type: ScalarType, operator_text: str, text: str) -> Condition:
    """The comparison of a parameter with a value written as text."""
    operator = _operator(node, operator_text)
    encoding = data_type.encoding
    named = data_type.labels or data_type.is_boolean
    if (named and left.calibrated) or isinstance(encoding, StringEncoding):
        _expect(node, operator in ("==", "!="), "== or != for a name", operator)
    if data_type.labels and left.calibrated:
        ranges = tuple((first, last) for first, last, label in data_type.labels if label == text)
        known = ", ".join(repr(label) for _, _, label in data_type.labels[:8])
        _expect(node, bool(ranges), f"a name of a code ({known})", repr(text))
        return CodeIn(left, ranges, operator == "!=")
    if data_type.is_boolean and left.calibrated:
        plain = {"true": True, "1": True, "false": False, "0": False}.get(text.lower())
        truth = dict(zip(data_type.truth, (False, True), strict=True)).get(text, plain)
        if truth is None:
            raise node.error(f"true, false, {' or '.join(map(repr, data_type.truth))}", repr(text))
        return Comparison(left, operator, truth)
    if isinstance(encoding, StringEncoding):
        return Comparison(left, operator, text)
    if isinstance(encoding, BinaryEncoding):
        raise node.error("a comparison of a number, a text or a name", f"one of the octets {left.parameter!r}")
    calibrated = left.calibrated and encoding.calibration != Calibration()
    try:
        if isinstance(encoding, IntegerEncoding) and not calibrated:
            return Comparison(left, operator, _whole(re.sub(r"\.0+\Z", "", text.strip())))
        value = float(text)
    except ValueError:
        raise node.error("a number", repr(text)) from None
    _expect(node, not math.isnan(value), "a number", repr(text))
    return Comparison(left, operator, value)


def _calibrator(node: Node, extrapolate: bool) -> Calibrator:
    kinds = ("PolynomialCalibrator", "SplineCalibrator")
    node.only((*kinds, "AncillaryDataSet"), _NAMED)
    listed = [child for child in node.children if child.tag in kinds]
    _expect(node, len(listed) == 1, f"one of {' and '.join(kinds)}", f"{len(listed)}")
    inner = listed[0]
    if inner.tag == "PolynomialCalibrator":
        inner.only(("Term", "AncillaryDataSet"), _NAMED)
        terms = []
        for term in inner.all("Term"):
            exponent = _integer(term, "exponent", None)
            _expect(term, 0 <= exponent <= MAX_EXPONENT, f"an exponent of 0 to {MAX_EXPONENT}", f"{exponent}")
            terms.append((_number(term, "coefficient", None), exponent))
        _expect(inner, bool(terms), "a Term", "none")
        exponents = [exponent for _, exponent in terms]
        _expect(inner, len(set(exponents)) == len(exponents), "each exponent once", str(exponents))
        return Polynomial(tuple(terms))
    inner.only(("SplinePoint", "AncillaryDataSet"), (*_NAMED, "order", "extrapolate"))
    points = sorted({(_number(p, "raw", None), _number(p, "calibrated", None)) for p in inner.all("SplinePoint")})
    order = _integer(inner, "order", 1)
    _expect(inner, order in (0, 1), "order 0 or 1", f"{order}")
    for point in inner.all("SplinePoint"):
        own = _integer(point, "order", order)
        _expect(point, own == order, f"order {order}, that of the calibrator", f"{own}")
    _expect(inner, len(points) >= 2, "two points or more", f"{len(points)}")
    rising = all(a[0] < b[0] for a, b in itertools.pairwise(points))
    _expect(inner, rising, "one calibrated value for each raw value", "two")
    return Spline(tuple(points), order, _boolean(inner, "extrapolate", extrapolate))


def _labels(node: Node, listed: Node | None, encoding: Encoding) -> tuple[tuple[int, int, str], ...]:
    """(first code, last code, name), codes rising."""
    if listed is None:
        raise node.error("an EnumerationList", "none")
    assert isinstance(encoding, IntegerEncoding)
    listed.only(("Enumeration",))
    least, greatest = _range(encoding)
    labels = []
    for one in listed.children:
        one.only((), ("value", "maxValue", "label", "shortDescription"))
        first = _integer(one, "value", None)
        last = _integer(one, "maxValue", first)
        _expect(one, least <= first <= last <= greatest, f"codes of {least} to {greatest}", f"{first} to {last}")
        labels.append((first, last, one.attribute("label")))
    _expect(listed, bool(labels), "an Enumeration", "none")
    labels.sort(key=lambda label: label[0])
    for before, after in itertools.pairwise(labels):
        _expect(listed, before[1] < after[0], "one name for each code", f"two for {after[0]}")
    return tuple(labels)


def _range(encoding: IntegerEncoding) -> tuple[int, int]:
    if encoding.form == "unsigned":
        return 0, (1 << encoding.bits) - 1
    return -(1 << encoding.bits - 1), (1 << encoding.bits - 1) - 1


def _limits(chain: Sequence[tuple[_System, Node]], levels: tuple[str, ...]) -> Limits | None:
    """Return the range of values without alarm of the first of these levels that is stated; None without any.

    Other alarms (inside of a range, of changes, of names, in a context) are not read.
    """
    ranges = _static_ranges(chain)
    if ranges is None:
        return None
    stated = next((found for level in levels if (found := ranges.child(level)) is not None), None)
    if stated is None:
        return None
    return _limit(stated, "min", math.inf), _limit(stated, "max", -math.inf)


def _limit(stated: Node, side: str, inside: float) -> float | None:
    """Return the last value without alarm on a side; an exclusive limit is an alarm itself."""
    if f"{side}Inclusive" in stated.attributes:
        return _number(stated, f"{side}Inclusive", None)
    if f"{side}Exclusive" in stated.attributes:
        return math.nextafter(_number(stated, f"{side}Exclusive", None), inside)
    return None


def _static_ranges(chain: Sequence[tuple[_System, Node]]) -> Node | None:
    """Return the ranges whose outside is an alarm, None without any."""
    alarm = next((found for _, one in chain if (found := one.child("DefaultAlarm")) is not None), None)
    ranges = alarm.child("StaticAlarmRanges") if alarm is not None else None
    outside = ranges is not None and ranges.attributes.get("rangeForm", "outside") == "outside"
    return ranges if outside else None


def _alarms_not_read(chain: Sequence[tuple[_System, Node]]) -> int:
    """Return the number of alarms of a type other than the ranges that `_limits` reads, and of those that wait."""
    read = _static_ranges(chain)
    used = [next((one for one in levels if read and read.child(one)), "") for levels in (_WARNING, _ALARM)]
    lists = ("DefaultAlarm", "ContextAlarmList", "BinaryContextAlarmList")
    holders = [child for _, one in chain for child in one.children if child.tag in lists]
    found = [alarm for holder in holders for alarm in holder.children]
    ranges = [
        one
        for alarm in found
        if alarm.tag == "StaticAlarmRanges"
        for one in alarm.children
        if one.tag in (*_WARNING, *_ALARM) and not (alarm is read and one.tag in used)
    ]
    late = sum(_integer(holder, "minViolations", 1) > 1 for holder in holders)
    return len(ranges) + late + sum(alarm.tag in _ALARMS for alarm in found)


def _stated(chain: Sequence[tuple[_System, Node]], name: str, default: str) -> str:
    """Return an attribute of a type, or of the nearest base type that states it."""
    return next((one.attributes[name] for _, one in chain if name in one.attributes), default)


def _is_little(node: Node, bits: int) -> bool:
    """Return whether the least significant octet of a number comes first."""
    orders = {"mostSignificantByteFirst": False, "leastSignificantByteFirst": True}
    order = node.attributes.get("byteOrder", "mostSignificantByteFirst")
    octets = [str(octet) for octet in range(bits // 8)] if bits % 8 == 0 else []
    orders |= {",".join(octets): True, ",".join(reversed(octets)): False}
    _expect(node, order in orders, f"byteOrder {' or '.join([*orders][:2])}", order)
    return orders[order]


def _fixed(node: Node, least: int | None) -> int:
    try:
        value = _whole(node.text)
    except ValueError:
        raise node.error("a whole number", repr(node.text)) from None
    low = -MAX_BITS if least is None else least
    _expect(node, low <= value <= MAX_BITS, f"a number of {low} to {MAX_BITS}", f"{value}")
    return value


def _whole(text: str) -> int:
    if len(text) > 40:
        raise ValueError("too long")
    plain = text.strip().lower()
    sign = -1 if plain.startswith("-") else 1
    digits = plain.lstrip("+-")
    for prefix, base in (("0x", 16), ("0b", 2), ("0o", 8)):
        if digits.startswith(prefix):
            return sign * int(digits[2:], base)
    return int(plain)


def _integer(node: Node, name: str, default: int | None) -> int:
    if default is not None and name not in node.attributes:
        return default
    text = node.attribute(name)
    try:
        return _whole(text)
    except ValueError:
        raise node.error(f"a whole number as {name}", repr(text[:40])) from None


def _number(node: Node, name: str, default: float | None) -> float:
    if default is not None and name not in node.attributes:
        return default
    text = node.attribute(name)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    _expect(node, math.isfinite(value), f"a finite number as {name}", repr(text[:40]))
    return value


def _boolean(node: Node, name: str, default: bool) -> bool:
    text = node.attributes.get(name, "true" if default else "false")
    known = {"true": True, "1": True, "false": False, "0": False}
    plain = text.strip().lower()
    _expect(node, plain in known, f"true or false as {name}", repr(text))
    return known[plain]
