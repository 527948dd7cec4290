"""Messages out of log files: MCAP, rosbag2 folders and databases, ROS 1 bags.

The containers are read by the `mcap` and `rosbags` libraries, of the extra `io`. Files are foreign:
what they unpack to is checked before memory is taken.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from palpate.errors import PalpateError, extra_module
from palpate.recordings.alignment import MAX_BYTES
from palpate.recordings.rosbag.decoding import Decode, ros_decoder
from palpate.runs.run import RECORDING
from palpate.runs.storage import DamagedFileError, parse_json

CHUNK = 2**30  # bytes of one record or one unpacked chunk; writers make them a thousandth of this
_LZ4_RATIO = 255  # nothing that LZ4 packs is smaller by more than that
_FORMATS = {".mcap": "MCAP", ".bag": "ROS 1 bag", ".db3": "rosbag2 database"}


class Packed(NamedTuple):
    """A message as it was recorded: `decode(data)` was `received` at a time in ns."""

    topic: str
    received: int
    decode: Decode
    data: bytes


@dataclass
class Bag:
    """A log: `format` is what a person calls its kind, `paths` are files that follow one another.

    It says of itself what the types of messages are, by topic, and how many its index promises
    (`counts`). `read` counts those that came out, and `unreadable` says of a topic why others did
    not. All of it is complete once all messages were read.
    """

    format: str
    paths: Sequence[Path]
    types: dict[str, str] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    read: Counter[str] = field(default_factory=Counter)
    unreadable: dict[str, str] = field(default_factory=dict)

    def messages(self, skipped: Collection[str]) -> Iterator[Packed]:
        """All messages but those of `skipped` topics, which may grow meanwhile.

        What damaged files make the libraries raise comes out as it is.
        """
        for path in self.paths:
            read = _mcap_messages if path.suffix.lower() == ".mcap" else _ros_messages
            yield from read(self, path, skipped)

    def decoder(self, topic: str, kind: str, definition: str, encoding: str) -> Decode | None:
        """How to read the messages of a topic; None, with the reason kept, if nobody can."""
        try:
            return ros_decoder(kind, definition, encoding)
        except PalpateError as error:
            self.unreadable[topic] = str(error)
            return None


def is_bag(path: Path) -> bool:
    """Whether `path` is called like a log, or is a folder, such as `ros2 bag record` writes."""
    return path.suffix.lower() in _FORMATS or (path.is_dir() and not (path / RECORDING).exists())


def open_bag(path: Path) -> Bag:
    """The log at `path`: a file, or a folder with metadata.yaml and .mcap or .db3 files.

    Raises `PalpateError` without the extra `io` and for what is no log, `OSError` as the file
    system does, and whatever the libraries raise for damaged files.
    """
    for package in ("mcap", "rosbags"):
        extra_module(package, "io")
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            raise PalpateError(
                "the folder has no metadata.yaml: expected one that `ros2 bag record` has written "
                "(`ros2 bag reindex` writes a lost one again)"
            )
        return Bag("rosbag2 folder", sorted(path.glob("*.mcap")) or [path])
    if path.stat().st_size == 0:
        raise DamagedFileError("the file is empty")
    return Bag(_FORMATS[path.suffix.lower()], [path])


def _mcap_messages(bag: Bag, path: Path, skipped: Collection[str]) -> Iterator[Packed]:
    from mcap.exceptions import EndOfFile, InvalidMagic
    from mcap.reader import SeekingReader
    from mcap.records import Channel, Message, Schema

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    decoders: dict[int, Decode | None] = {}

    def add(channel: Any) -> None:
        schema = schemas.get(channel.schema_id)
        channels[channel.id] = channel
        bag.types[channel.topic] = schema.name if schema else channel.message_encoding

    def decoder(channel: Any) -> Decode | None:
        schema = schemas.get(channel.schema_id)
        if channel.message_encoding == "json":
            return parse_json
        if channel.message_encoding in ("cdr", "ros1") and schema is not None:
            return bag.decoder(channel.topic, schema.name, schema.data.decode(), schema.encoding)
        bag.unreadable[channel.topic] = f"its messages are encoded as '{channel.message_encoding}'"
        return None

    with path.open("rb") as file:
        try:
            summary = SeekingReader(file, record_size_limit=CHUNK).get_summary()
        except (EndOfFile, InvalidMagic, OSError) as error:
            raise DamagedFileError(
                "the file has no end: it was cut off, or its recording was never finished "
                "(`mcap recover` saves what is there)"
            ) from error
        if summary:
            schemas |= summary.schemas
            for channel in summary.channels.values():
                add(channel)
        for record in _records(file, summary, skipped):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                add(record)
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                if channel.topic in skipped:
                    continue
                if channel.id not in decoders:
                    decoders[channel.id] = decoder(channel)
                if decode := decoders[channel.id]:
                    yield Packed(channel.topic, record.log_time, decode, record.data)
    if summary and summary.statistics:
        for identity, count in summary.statistics.channel_message_counts.items():
            if identity in channels:
                bag.counts[channels[identity].topic] += count


def _records(file: Any, summary: Any, skipped: Collection[str]) -> Iterator[Any]:
    """The records of an MCAP file; where an index allows it, without chunks of `skipped` topics."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    indexes = summary.chunk_indexes if summary else []
    topics = {name for index in indexes for name in index.message_index_offsets}
    # An index without every topic and definition lacks those that are in a chunk.
    if not indexes or not (
        topics <= summary.channels.keys()
        and {c.schema_id for c in summary.channels.values()} - {0} <= summary.schemas.keys()
    ):
        file.seek(0)
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=CHUNK)
        for record in reader.records:
            if isinstance(record, Chunk):
                yield from _unpack(record)
            else:
                yield record
        return
    for index in sorted(indexes, key=lambda index: index.chunk_start_offset):
        topics = {summary.channels[identity].topic for identity in index.message_index_offsets}
        if not topics or not topics <= set(skipped):
            file.seek(index.chunk_start_offset)
            opcode, length = file.read(1), int.from_bytes(file.read(8), "little")
            if opcode != b"\x06" or length > CHUNK:
                raise DamagedFileError("the index of the file does not fit its content")
            yield from _unpack(Chunk.read(ReadDataStream(file)))


def _unpack(chunk: Any) -> list[Any]:
    """The records in a chunk, after a look at how much memory they take."""
    import zstandard
    from lz4.frame import get_frame_info
    from mcap.stream_reader import breakup_chunk

    size = chunk.uncompressed_size
    if chunk.compression == "zstd":
        size = max(size, zstandard.frame_content_size(chunk.data))
    elif chunk.compression == "lz4":
        said = get_frame_info(chunk.data)["content_size"]
        size = max(size, said or _LZ4_RATIO * len(chunk.data))
    if size > CHUNK:
        raise PalpateError(
            f"a chunk of the file unpacks to {size / 2**30:.3g} GiB; at most {CHUNK / 2**30:.0f} "
            "GiB are read"
        )
    return breakup_chunk(chunk, validate_crc=True)


def _ros_messages(bag: Bag, path: Path, skipped: Collection[str]) -> Iterator[Packed]:
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    for packed in path.glob("*.zstd") if path.is_dir() else ():
        _check_packed(packed)
    plain, reader_of = ("ros1msg", Reader1) if path.suffix == ".bag" else ("ros2msg", Reader2)
    with reader_of(path) as reader:
        decoders = {}
        for connection in reader.connections:
            topic, definition = connection.topic, connection.msgdef
            encoding = "ros2idl" if definition.format == MessageDefinitionFormat.IDL else plain
            bag.types[topic] = connection.msgtype
            bag.counts[topic] += connection.msgcount
            decoders[connection.id] = bag.decoder(
                topic, connection.msgtype, definition.data, encoding
            )
        for connection, received, data in reader.messages():
            decode = decoders[connection.id]
            if decode is not None and connection.topic not in skipped:
                yield Packed(connection.topic, received, decode, data)


def _check_packed(path: Path) -> None:
    """Refuse a database that is packed as a whole and would take too much room unpacked."""
    import zstandard

    with path.open("rb") as file:
        size = zstandard.frame_content_size(file.read(32))
        if size < 0:  # it does not say
            file.seek(0)
            size = 0
            stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
            while size <= MAX_BYTES and (part := stream.read(2**20)):
                size += len(part)
    if size > MAX_BYTES:
        raise PalpateError(
            f"{path.name} unpacks to more than {MAX_BYTES / 2**30:.0f} GiB: convert it with "
            "`ros2 bag convert` to one that is not packed"
        )
