"""Output of every command: results on standard output, messages and progress on standard error.

Text is printed literally: square brackets and colons in a path or a PX4 message are not markup. Style is
passed as `style=` or as `rich.text.Text`. Characters that the output's encoding lacks are escaped. A failed
write to standard output raises `OutputError`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import msgspec

from dart_flight.base.errors import FlightError
from dart_flight.base.text import ESCAPED, printable
from dart_flight.config.document import report_write_errors

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.text import Text

_STANDARD = (0, 1, 2)  # descriptors of the standard streams


class OutputError(FlightError):
    """Error of a failed write to standard output.

    Attributes:
        closed: whether the reader has closed the pipe (`| head`), so that no message is needed.
    """

    def __init__(self, error: OSError) -> None:
        super().__init__(f"cannot write standard output: {error.strerror or error}")
        self.closed = error.errno == errno.EPIPE


class _OutputStream:
    """Standard output or standard error, looked up in `sys` at every write.

    A message that cannot be written to standard error (full disk, closed terminal) is discarded, so that it
    does not end a flight.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def write(self, text: str) -> int:
        """Write text, and escape the characters that the encoding lacks."""
        with self._errors():
            stream = self._stream
            try:
                stream.write(printable(text))
            except UnicodeEncodeError:
                encoding = stream.encoding
                stream.write(text.encode(encoding, ESCAPED).decode(encoding))
        return len(text)

    def flush(self) -> None:
        with self._errors():
            self._stream.flush()

    @property
    def _stream(self) -> Any:
        stream = getattr(sys, self._name)
        return getattr(stream, "rich_proxied_file", stream)  # bypass a progress bar's replacement stream

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
    """Redirect a broken stream to the null device, so that closing it at exit succeeds."""
    with contextlib.suppress(OSError):  # a stream without a descriptor needs no redirection
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


_OUTPUT, _MESSAGES = cast("IO[str]", _OutputStream("stdout")), cast("IO[str]", _OutputStream("stderr"))


def open_closed_streams() -> None:
    """Open a descriptor for each closed standard stream (`>&-`), before any file or link is opened.

    Otherwise a log or serial link would get the descriptor number of a closed stream. Text that a library
    prints to this stream would then end up in the log or on the link. Writing to a closed standard output
    still fails.
    """
    for number in _STANDARD:
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDONLY)  # the file gets the lowest free number, which is `number`
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", errors=ESCAPED, closefd=False))


def messages() -> Console:
    """Return the console for progress and messages: standard error."""
    from rich.console import Console  # rich imports slowly, and `--help` does not need rich

    return Console(file=_MESSAGES, highlight=False, markup=False, emoji=False)


def print_status(*lines: object) -> None:
    """Print lines on standard error; the terminal may wrap them."""
    for line in lines:
        _MESSAGES.write(f"{line}\n")
    _MESSAGES.flush()


def confirm(question: str) -> bool:
    """Ask a question on the terminal and return the answer; without a terminal the answer is no."""
    if not sys.stdin.isatty():
        return False
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def write_text(path: Path, text: str) -> None:
    """Write a file and print its path."""
    with report_write_errors(path):
        path.write_text(text, encoding="utf-8", errors=ESCAPED)
    print_status(f"wrote {path}")


def tables() -> Console:
    """Return the console for results that are not JSON: standard output."""
    from rich.console import Console

    return Console(file=_OUTPUT, highlight=False, markup=False, emoji=False)


@contextlib.contextmanager
def live_screen(period_s: float = 2.0) -> Iterator[Callable[[RenderableType, Text], None]]:
    """Yield a function that shows a screen in place; without a terminal, it prints a line once per period.

    The arguments of the function are the screen and the line.
    """
    from rich.live import Live

    console = tables()
    if console.is_terminal:
        with Live(console=console, auto_refresh=False, transient=False) as live:
            yield lambda screen, line: live.update(screen, refresh=True)
        return
    due_s, waiting = time.monotonic(), list[Any]()

    def show(screen: RenderableType, line: Text) -> None:
        nonlocal due_s
        waiting[:] = [line]
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + period_s
            console.print(waiting.pop(), soft_wrap=True)

    try:
        yield show
    finally:
        for line in waiting:  # show the last state
            console.print(line, soft_wrap=True)


def styled(*parts: str | tuple[str, str]) -> Text:
    """Return a line of parts; each part is a string, or a pair of string and style."""
    from rich.text import Text

    return Text.assemble(*parts)


def write_output(text: str) -> None:
    _OUTPUT.write(text)
    _OUTPUT.flush()


def emit_json(value: Any) -> None:
    """Print one object as JSON on standard output; a number that is not finite becomes null."""
    try:
        data = msgspec.json.encode(value)
    except UnicodeEncodeError:  # a file name in `value` is not UTF-8
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
    """If the result of completed work cannot be printed, keep the exit status of that work.

    `outcome` is the result in one line, printed on standard error if standard output fails.
    """
    try:
        yield
    except OutputError as error:
        print_status(f"{outcome} ({error})")
