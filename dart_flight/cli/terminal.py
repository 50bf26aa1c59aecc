"""What every command prints with: JSON alone on standard output, everything else on standard error.

Text is printed as it is: square brackets and colons in a path or in a message of PX4 are no markup. Style is
given as `style=` or as `rich.text.Text`. Characters that the output's encoding lacks are escaped.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.text import ESCAPED, printable
from dart_flight.config.document import writing

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

_STANDARD = (0, 1, 2)  # descriptors of the standard streams


class OutputError(FlightError):
    """Standard output does not take what is printed.

    Attributes:
        closed: its reader has gone (`| head`): nobody is left to be told.
    """

    def __init__(self, error: OSError) -> None:
        super().__init__(f"cannot write standard output: {error.strerror or error}")
        self.closed = error.errno == errno.EPIPE


class _OutputStream:
    """Standard output or standard error as it is at the moment of writing.

    A message that standard error does not take (a full disk, a terminal that is gone) is dropped: no flight
    ends because of it.

    Args:
        name: `stdout` or `stderr`.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def write(self, text: str) -> int:
        """Write text, escaped as far as the encoding asks for it.

        Raises:
            OutputError: standard output does not take it.
        """
        with self._errors():
            stream = self._stream
            try:
                stream.write(printable(text))
            except UnicodeEncodeError:
                encoding = stream.encoding
                stream.write(text.encode(encoding, ESCAPED).decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Hand on what was written.

        Raises:
            OutputError: as `write`.
        """
        with self._errors():
            self._stream.flush()

    @property
    def _stream(self) -> Any:
        stream = getattr(sys, self._name)
        return getattr(stream, "rich_proxied_file", stream)  # while a progress bar is shown

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            _discard(self._stream)
            if self._name == "stdout":
                raise OutputError(error) from None


def _discard(stream: IO[str]) -> None:
    """Lead a stream that takes nothing to nowhere, so that closing it at the program's end succeeds."""
    with contextlib.suppress(OSError):  # a stream without a descriptor has nothing to be led
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


_OUTPUT, _MESSAGES = cast("IO[str]", _OutputStream("stdout")), cast("IO[str]", _OutputStream("stderr"))


def open_closed_streams() -> None:
    """Give standard streams that were closed (`>&-`) a descriptor, before a file or a link gets its number.

    Libraries print to these numbers: into the log or the serial link, where they are those. A closed output
    stays one that refuses what is printed.
    """
    for number in _STANDARD:
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDONLY)  # gets the lowest free number, which is this one
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", errors=ESCAPED, closefd=False))


def messages() -> Console:
    """Console for progress and messages: standard error."""
    from rich.console import Console  # takes a while: `--help` does without

    return Console(file=_MESSAGES, highlight=False, markup=False, emoji=False)


def print_status(*lines: object) -> None:
    """Lines on standard error, which the terminal may break."""
    for line in lines:
        _MESSAGES.write(f"{line}\n")
    _MESSAGES.flush()


def write_text(path: Path, text: str) -> None:
    """Write a file, and say so.

    Raises:
        InputError: it cannot be written.
    """
    with writing(path):
        path.write_text(text, encoding="utf-8", errors=ESCAPED)
    print_status(f"wrote {path}")


def tables() -> Console:
    """Console for what the command was asked for, when it is not `--json`: standard output.

    Printing raises `OutputError` where it does not take it.
    """
    from rich.console import Console

    return Console(file=_OUTPUT, highlight=False, markup=False, emoji=False)


def styled(*parts: str | tuple[str, str]) -> Text:
    """Return a line of parts, each text or (text, style)."""
    from rich.text import Text

    return Text.assemble(*parts)


def write_output(text: str) -> None:
    """Write text on standard output as it is.

    Raises:
        OutputError: it does not take it.
    """
    _OUTPUT.write(text)
    _OUTPUT.flush()


def emit_json(value: Any) -> None:
    """Print one object as JSON on standard output; a number that is not finite becomes null.

    Raises:
        OutputError: standard output does not take it.
    """
    try:
        data = msgspec.json.encode(value)
    except UnicodeEncodeError:  # a file name in it is not UTF-8
        data = msgspec.json.encode(_printable(msgspec.to_builtins(value)))
    write_output(msgspec.json.format(data, indent=2).decode() + "\n")


def _printable(value: Any) -> Any:
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {_printable(key): _printable(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_printable(part) for part in value]
    return value


@contextlib.contextmanager
def keep_status(outcome: str) -> Iterator[None]:
    """Print the result of something that has happened: an output that takes nothing does not undo it.

    Args:
        outcome: what has happened, in a line; goes to standard error where standard output fails.
    """
    try:
        yield
    except OutputError as error:
        print_status(f"{outcome} ({error})")
