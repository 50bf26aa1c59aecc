"""The log's writer against the library's own."""

from __future__ import annotations

import io
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from dart_flight.recording import mcap_writer
from dart_flight.recording.mcap_writer import McapWriter

Make = Callable[[io.BytesIO], Writer]
_LARGE = 600 * 1024  # two of them are more than a chunk takes

_messages = st.lists(
    st.tuples(
        st.integers(1, 3),  # channel
        st.integers(0, 2**63),  # time
        st.one_of(st.binary(max_size=40), st.just(b"x" * _LARGE)),
        st.integers(0, 2**32 - 1),  # number
        st.booleans(),  # whether the chunk ends after it
    ),
    max_size=12,
)


def file_of(make: Make, messages: list[tuple[int, int, bytes, int, bool]]) -> bytes:
    file = io.BytesIO()
    writer = make(file)
    writer.start(profile="p", library="l")
    schema = writer.register_schema("s", "jsonschema", b"{}")
    for topic in ("/a", "/b", "/c"):
        writer.register_channel(topic, "json", schema)
    writer.add_metadata("about", {"k": "v"})
    for channel, time_ns, data, number, ends in messages:
        writer.add_message(channel, time_ns, data, time_ns // 2, number)
        if ends:
            writer.flush()  # type: ignore[no-untyped-call]
    writer.finish()  # type: ignore[no-untyped-call]
    return file.getvalue()


def library(file: io.BytesIO) -> Writer:
    return Writer(file, compression=CompressionType.ZSTD)


@given(_messages)
def test_it_writes_what_the_library_writes(messages: list[tuple[int, int, bytes, int, bool]]) -> None:
    assert file_of(McapWriter, messages) == file_of(library, messages)


def test_it_makes_fewer_calls() -> None:
    """Of the library's own it would be the same bytes too; this is that it is not."""
    writer = McapWriter(io.BytesIO())
    writer.start()
    writer.register_channel("/a", "json", 0)
    writer.add_message(1, 1, b"1", 1)
    assert all(isinstance(index, mcap_writer._Index) for index in writer._chunk.message_indices.values())


def test_with_a_library_built_otherwise_it_takes_the_librarys_way() -> None:
    messages = [(1, 5, b"1", 7, False), (2, 6, b"2", 8, True)]

    def unknown(file: io.BytesIO) -> Writer:
        writer = McapWriter(file)
        writer._known = False
        return writer

    data = file_of(unknown, messages)
    assert data == file_of(library, messages)
    read = make_reader(io.BytesIO(data)).iter_messages()
    assert [(channel.topic, message.data) for _, channel, message in read] == [("/a", b"1"), ("/b", b"2")]
