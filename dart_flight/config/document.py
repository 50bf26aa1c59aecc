"""A YAML file as a tree of plain values with line numbers, and its conversion to a type.

PyYAML parses the text to events, in which this module checks depth, duplicate keys and aliases. msgspec
converts and validates. This module adds the line, the full key and the nearest known name to errors.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import itertools
import math
import os
import pwd
import re
import shlex
import stat
from collections.abc import Iterable, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeVar, get_args, get_origin

import msgspec
import yaml

from dart_flight.base.text import printable
from dart_flight.config.units import unit_from_name

T = TypeVar("T")
Key = tuple[str | int, ...]

IN_PYTHON = "<dict>"  # `source` of a document from Python instead of a file
_MAX_BYTES = 1_000_000
MAX_TABLE_BYTES = 200_000_000  # maximum size of CSV files: an hour of trials at 1 kHz
MAX_LOG_BYTES = 2_000_000_000  # maximum size of logs: PX4 writes up to 500 MB an hour
_MAX_DEPTH = 32
# YAML 1.1 reads 1e-3 as a string. Read such text as a number, like YAML 1.2.
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\Z")
_INTEGER = re.compile(r"[-+]?\d+\Z")
_SPECIAL: dict[str, Any] = {
    "": None,
    "~": None,
    "null": None,
    "true": True,
    "false": False,
    ".inf": math.inf,
    "-.inf": -math.inf,
    "+.inf": math.inf,
    ".nan": math.nan,
}


class InputError(ValueError):
    """An input error in one line: `file:line: key: problem, allowed values`.

    The command line prints the error and exits with status 2, before the vehicle or the lock moves. For input
    from Python, `<dict>` replaces file and line. The command line prints `hints` below the error.
    """

    def __init__(
        self,
        message: str,
        *,
        source: str = "",
        line: int | None = None,
        key: Key = (),
        hints: tuple[str, ...] = (),
    ) -> None:
        self.source, self.line, self.key, self.message = source, line, key, " ".join(message.split())
        self.hints = hints
        super().__init__(self.one_line())

    def one_line(self) -> str:
        """Return the error as one line of text."""
        place = self.source if self.line is None else f"{self.source}:{self.line}"
        line = ": ".join(part for part in (place, dotted(self.key), self.message) if part)
        # A key or value may contain characters that break the line or control the terminal.
        return "".join(c if c.isprintable() else "?" for c in printable(line))


def utf8_path(path: str | Path) -> str:
    """Return the text of a path; raise InputError if the path is not UTF-8, because JSON cannot store it."""
    text = str(path)
    if printable(text) != text:
        raise InputError("the file name is not UTF-8; rename the file or choose another folder", source=text)
    return text


@contextlib.contextmanager
def report_write_errors(path: str | Path) -> Iterator[None]:
    """Convert write errors inside the context to `InputError`."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write: {write_problem(path, error)}", source=str(path)) from None


def write_problem(path: str | Path, error: OSError) -> str:
    """Return the reason why a path cannot be written, in one line.

    If the reason is a file or folder of another account (for example, one left behind by `sudo`), the text
    names that file or folder, its owner and the remedy.
    """
    reason = error.strerror or str(error)
    place = Path(error.filename if isinstance(error.filename, str) else path).absolute()
    near = next((p for p in (place, *place.parents) if os.path.exists(p)), place)
    if error.errno not in (errno.EACCES, errno.EPERM) or os.access(near, os.W_OK, effective_ids=True):
        return reason
    owner = near.stat().st_uid
    if owner == os.geteuid():
        return f"{reason}: the mode of {near} does not permit writing; chmod u+w {shlex.quote(str(near))}"
    *_, theirs = itertools.takewhile(lambda p: p.stat().st_uid == owner, (near, *near.parents))
    remedy = "choose a folder that you can write to"
    if os.access(theirs.parent, os.W_OK, effective_ids=True):
        heir = account_name(theirs.parent.stat().st_uid)
        remedy = f"sudo chown -R {heir} {shlex.quote(str(theirs))}"
    what = "it" if near == Path(path).absolute() else near
    return f"{reason}: {what} belongs to {account_name(owner)}; {remedy}"


def account_name(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def replace_file(path: Path, data: bytes) -> None:
    """Write a file completely or not at all, and flush it to the disk; an interrupted write changes nothing.

    A symbolic link and the mode of an existing file are kept. A device is written directly.

    Raises:
        OSError: the file cannot be written.
    """
    target = path.resolve()
    if target.exists() and not target.is_file():
        target.write_bytes(data)
        return
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            part.chmod(target.stat().st_mode & 0o777)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


Stamp = tuple[int, int, int] | None  # modification time, size, inode; None if there is no file
_noting: list[dict[Path, Stamp]] = []


def stamp_of(path: Path) -> Stamp:
    """Return a value that changes whenever a file is saved, even by an editor that replaces the file."""
    try:
        about = path.stat()
    except (OSError, ValueError):
        return None
    return (about.st_mtime_ns, about.st_size, about.st_ino)


@contextlib.contextmanager
def noting_files() -> Iterator[dict[Path, Stamp]]:
    """Collect the files that are opened within the context, with each file's stamp before it is opened."""
    noted: dict[Path, Stamp] = {}
    _noting.append(noted)
    try:
        yield noted
    finally:
        _noting.remove(noted)


def open_file(path: str | Path, most_bytes: int = MAX_LOG_BYTES) -> BinaryIO:
    """Open a file named by the operator for reading; every command opens its input here.

    Only regular files up to `most_bytes` are accepted, because a pipe might not deliver any data, and reading
    a device might not end.
    """
    source = str(path)
    for noted in _noting:
        absolute = Path(os.path.abspath(path))
        noted.setdefault(absolute, stamp_of(absolute))
    try:
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb")
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read: {getattr(error, 'strerror', None) or error}", source=source) from None
    about = os.fstat(file.fileno())
    problem = None
    if stat.S_ISDIR(about.st_mode):
        problem = "a folder, expected a file"
    elif not stat.S_ISREG(about.st_mode):
        problem = f"a {'pipe' if stat.S_ISFIFO(about.st_mode) else 'device'}, expected a regular file"
    elif about.st_size > most_bytes:
        problem = f"larger than {most_bytes / 1e6:g} MB ({about.st_size / 1e6:.0f} MB)"
    if problem is not None:
        file.close()
        raise InputError(problem, source=source)
    return file


def read_text(path: str | Path, most_bytes: int = MAX_TABLE_BYTES) -> str:
    """Return the UTF-8 text of a file named by the operator, without a byte order mark; see `open_file`."""
    with open_file(path, most_bytes) as file:
        try:
            return file.read(most_bytes).decode("utf-8-sig")
        except OSError as error:
            raise InputError(f"cannot read: {error.strerror or error}", source=str(path)) from None
        except UnicodeDecodeError:
            raise InputError("not UTF-8 text", source=str(path)) from None


def dotted(key: Key) -> str:
    """Return `("walls", "wood", "normal", 0)` as `walls.wood.normal[0]`."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def iterate_leaves(tree: Any, key: Key = (), *, in_lists: bool = False) -> Iterator[tuple[Key, Any]]:
    """Yield the values of a tree with their keys. A list is one value; `in_lists` yields its entries."""
    inner: Iterable[tuple[str | int, Any]]
    if isinstance(tree, Mapping):
        inner = tree.items()
    elif in_lists and isinstance(tree, list | tuple):
        inner = enumerate(tree)
    else:
        yield key, tree
        return
    for name, value in inner:
        yield from iterate_leaves(value, (*key, name), in_lists=in_lists)


class Document:
    """A parsed YAML file: `tree` of dicts, lists and scalars, and the line of every key.

    `set_by` names the source of each value that is not from this file: an option (`config.settings`), or
    another configuration file. If this document is part of another document, `above` is the key of the part.

    Raises:
        InputError: the text is not YAML, is not a mapping, is too large, is nested too deep, or contains
            duplicate keys, aliases, tags or a number that is not finite.
    """

    def __init__(self, text: str, source: str) -> None:
        self.source = source
        self.lines: dict[Key, int] = {}
        self.set_by: dict[Key, str] = {}
        self.above: Key = ()
        if len(text) > _MAX_BYTES:
            raise InputError(f"larger than {_MAX_BYTES} bytes", source=source)
        try:
            loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
            events = iter(list(yaml.parse(text, Loader=loader)))
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = mark.line + 1 if mark else None
            problem = f"not valid YAML: {error.problem or error.context}"
            lines = text.splitlines()
            if mark is not None and mark.line < len(lines) and "\t" in lines[mark.line][: mark.column + 1]:
                problem = "a tab before the text: indent YAML with spaces"
            raise InputError(problem, source=source, line=line) from None
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            raise InputError(f"not valid YAML: {error}", source=source) from None
        self.tree = self._read(events)
        if not isinstance(self.tree, dict):
            raise InputError("expected keys and values, as in the examples in missions/", source=source)

    @classmethod
    def load(cls, path: str | Path) -> Document:
        return cls(read_text(path, _MAX_BYTES), printable(str(path)))

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any], source: str = IN_PYTHON) -> Document:
        """Return a document built in Python, as if its keys and values had been read from a file.

        Allowed values are finite numbers (also NumPy's), strings, booleans, None, and lists and mappings of
        these.
        """
        document = cls.__new__(cls)
        document.source, document.lines, document.set_by, document.above = source, {}, {}, ()
        document.tree = to_plain(tree, (), source)
        return document

    def part(self, name: str) -> Document:
        """Return the mapping below a key as a document; errors name the line and full key in the file."""
        part = Document.from_tree(self.tree[name], self.source)
        part.lines = {key[1:]: line for key, line in self.lines.items() if key[:1] == (name,)}
        part.above = (*self.above, name)
        return part

    def error(self, key: Key, message: str) -> InputError:
        """Return an error at a key of this document, with the line of the key.

        If the key is not in the file, the error points to the innermost section that would contain it. If an
        option such as `--set` has set the key, the error names this option instead of file and line.
        """
        for given, setting in self.set_by.items():
            # The setting caused an error at or below its key, or in a section that it has created.
            if key[: len(given)] == given or (key not in self.lines and given[: len(key)] == key):
                return InputError(message, source=setting)
        for length in range(len(key), -1, -1):
            line = self.lines.get(key[:length])
            if line is not None:
                return InputError(message, source=self.source, line=line, key=(*self.above, *key))
        return InputError(message, source=self.source, key=(*self.above, *key))

    def convert(self, type_: type[T]) -> T:
        try:
            return msgspec.convert(self.tree, type_)
        except msgspec.ValidationError as error:
            key, text = _locate_error(self.tree, type_, (), str(error))
            raise self.error(key, text) from None

    # -- parsing --

    def _read(self, events: Iterator[yaml.Event]) -> Any:
        result: Any = None
        documents = 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise self._error_at(event, "more than one YAML document in the file")
            elif isinstance(event, yaml.NodeEvent):
                result = self._node(event, events, ())
        return result

    def _node(self, event: yaml.Event, events: Iterator[yaml.Event], key: Key) -> Any:
        if len(key) > _MAX_DEPTH:
            raise self._error_at(event, f"nested deeper than {_MAX_DEPTH} levels")
        self.lines.setdefault(key, self._line(event))
        if isinstance(event, yaml.AliasEvent):
            raise self._error_at(event, "anchors and aliases are not supported; write the value out", key)
        if getattr(event, "anchor", None) is not None:
            raise self._error_at(event, "anchors and aliases are not supported; write the value out", key)
        tag = getattr(event, "tag", None)
        if tag is not None:
            raise self._error_at(event, f"tags are not supported: {tag}", key)
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event, key)
        if isinstance(event, yaml.SequenceStartEvent):
            items: list[Any] = []
            for item in events:
                if isinstance(item, yaml.SequenceEndEvent):
                    break
                items.append(self._node(item, events, (*key, len(items))))
            return items
        return self._mapping(events, key)

    def _mapping(self, events: Iterator[yaml.Event], key: Key) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for event in events:
            if isinstance(event, yaml.MappingEndEvent):
                break
            if not isinstance(event, yaml.ScalarEvent) or event.anchor is not None or event.tag is not None:
                raise self._error_at(event, "keys must be plain names", key)
            name = event.value
            if name in values:
                raise self._error_at(event, "this key appears twice", (*key, name))
            self.lines[(*key, name)] = self._line(event)
            values[name] = self._node(next(events), events, (*key, name))
        return values

    def _scalar(self, event: yaml.ScalarEvent, key: Key) -> Any:
        text = event.value
        if event.style in ("'", '"', "|", ">"):
            return text
        lowered = text.lower()
        if lowered in _SPECIAL:
            value = _SPECIAL[lowered]
        elif _INTEGER.match(text):
            if len(text) > 18:
                raise self._error_at(event, "number too large", key)
            value = int(text)
        elif _NUMBER.match(text):
            value = float(text)
        else:
            return text
        if isinstance(value, float) and not math.isfinite(value):
            raise self._error_at(event, f"numbers must be finite, not {text}", key)
        return value

    @staticmethod
    def _line(event: yaml.Event) -> int:
        return event.start_mark.line + 1 if event.start_mark else 1

    def _error_at(self, event: yaml.Event, message: str, key: Key = ()) -> InputError:
        return InputError(message, source=self.source, line=self._line(event), key=key)


# --- values from Python ------------------------------------------------------------------------------


def to_plain(value: Any, key: Key = (), source: str = IN_PYTHON) -> Any:
    """Return a Python value as plain data: dicts, lists, strings, finite numbers, booleans, None."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.to_builtins(value)
    elif hasattr(value, "tolist"):  # a NumPy array or number
        value = value.tolist()
    if len(key) > _MAX_DEPTH:
        raise InputError(f"nested deeper than {_MAX_DEPTH} levels", source=source, key=key)
    if isinstance(value, Mapping):
        return {
            _name(name, key, source): to_plain(part, (*key, str(name)), source)
            for name, part in value.items()
        }
    if isinstance(value, list | tuple):
        return [to_plain(part, (*key, i), source) for i, part in enumerate(value)]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"numbers must be finite, not {value}", source=source, key=key)
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise InputError(f"{type(value).__name__} is not a value that a file can hold", source=source, key=key)


def _name(name: Any, key: Key, source: str) -> str:
    if not isinstance(name, str):
        raise InputError(f"keys must be plain names, not {name!r}", source=source, key=key)
    return str(name)


# --- the location of a conversion error --------------------------------------------------------------


def _locate_error(value: Any, type_: Any, key: Key, text: str) -> tuple[Key, str]:
    """Find the smallest part of a value that cannot be converted; return the part's key and message.

    Each part is converted again, because msgspec's own path hides the names of dictionary keys
    (`$.walls[...].normal`).
    """
    text = text.split(" - at `", maxsplit=1)[0]
    for part_key, part, part_type in _parts(value, type_):
        if part_type is None:
            return (*key, part_key), f"unknown key{suggest_known(str(part_key), _field_names(type_))}"
        try:
            msgspec.convert(part, part_type)
        except msgspec.ValidationError as error:
            return _locate_error(part, part_type, (*key, part_key), str(error))
    return key, _explain(text, type_) + _range(type_, value, key)


def _parts(value: Any, type_: Any) -> Iterator[tuple[str | int, Any, Any]]:
    for option in _options(type_):
        origin, arguments = get_origin(option), get_args(option)
        if isinstance(option, type) and issubclass(option, msgspec.Struct) and isinstance(value, dict):
            types = {field.encode_name: field.type for field in msgspec.structs.fields(option)}
            for name, part in value.items():
                yield name, part, types.get(name)
        elif origin is dict and isinstance(value, dict):
            for name, part in value.items():
                yield name, part, arguments[1]
        elif origin in (list, tuple) and isinstance(value, list):
            fixed = origin is tuple and Ellipsis not in arguments
            if not fixed or len(arguments) == len(value):
                for i, part in enumerate(value):
                    yield i, part, arguments[i if fixed else 0]


def _options(type_: Any) -> Iterator[Any]:
    """Yield the type itself, or the members of a union, an alias or an annotation."""
    if hasattr(type_, "__metadata__"):
        yield from _options(get_args(type_)[0])
    elif isinstance(type_, type) or get_origin(type_) in (dict, list, tuple):
        yield type_
    else:
        for part in get_args(type_):
            yield from _options(part)


def _field_names(type_: Any) -> list[str]:
    return [
        field.encode_name
        for option in _options(type_)
        if isinstance(option, type) and issubclass(option, msgspec.Struct)
        for field in msgspec.structs.fields(option)
    ]


def _allowed_values(type_: Any) -> list[Any]:
    """Return the values of an enum or a Literal, including those inside a union."""
    if get_origin(type_) is Literal:
        return list(get_args(type_))
    if isinstance(type_, type) and issubclass(type_, Enum):
        return [member.value for member in type_]
    return [value for part in get_args(type_) for value in _allowed_values(part)]


_WORDS = {
    "`object`": "keys and values",
    "`array`": "a list",
    "`float`": "a number",
    "`int`": "a whole number",
    "`str`": "text",
    "`bool`": "true or false",
    "`null`": "nothing",
}


def _range(type_: Any, value: Any, key: Key) -> str:
    """Return the plausible range with its unit, and the number, as text; "" if the range is unknown."""
    limits = next(_limits(type_), None)
    if limits is None or isinstance(value, bool) or not isinstance(value, int | float):
        return ""
    low = limits.ge if limits.ge is not None else limits.gt
    high = limits.le if limits.le is not None else limits.lt
    unit = unit_from_name(next((part for part in reversed(key) if isinstance(part, str)), ""))
    if low is None or high is None:
        return ""
    shown = f"{low:g} to {high:g}{' ' if unit else ''}{unit}"
    return f" (plausible: {shown}, not {value:g}{(limits.extra or {}).get('note', '')})"


def _limits(type_: Any) -> Iterator[msgspec.Meta]:
    """Yield the limits of a number, including those inside a union."""
    if hasattr(type_, "__metadata__"):
        yield from (meta for meta in type_.__metadata__ if isinstance(meta, msgspec.Meta))
    elif get_origin(type_) not in (dict, list, tuple):
        for part in get_args(type_):
            yield from _limits(part)


def _explain(text: str, type_: Any) -> str:
    """Return an error message from msgspec in the terms of a YAML file."""
    if text.startswith("Invalid enum value"):
        allowed = ", ".join(str(value) for value in _allowed_values(type_))
        return f"{text[len('Invalid enum value ') :]} is not allowed, only: {allowed}"
    missing = re.match(r"Object missing required field `(.+)`", text)
    if missing:
        return f"missing key {missing[1]}"
    if "matching regex" in text:
        return "expected at most 64 letters, digits or characters of ' _.-', and a letter or digit first"
    for word, plain in _WORDS.items():
        text = text.replace(word, plain)
    return text[:1].lower() + text[1:]


def unknown_name(name: str, known: list[str], what: str = "") -> str:
    """Return the message for an unknown name; `what` describes the kind of name."""
    shown = f"{what} {name!r}" if what else name
    return f"unknown {shown}{suggest_known(name, known)}"


def suggest_known(name: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the nearest known name, or all known names."""
    names = list(known)
    parts = [other for other in names if other.startswith(f"{name}.")]
    if parts:  # the name belongs to a partition: suggest its faces
        return f", expected {' or '.join(parts)}"
    return did_you_mean(name, names) or f", known: {', '.join(names)}"


def did_you_mean(name: str, known: list[str]) -> str:
    """Return ", did you mean ...?" with the nearest known name, or "" if none is near."""
    near = difflib.get_close_matches(name, known, n=1)
    return f", did you mean {near[0]}?" if near else ""
