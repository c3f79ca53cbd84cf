"""`dpc prepare clouds`: anybody's point cloud files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from dpcli.cli.help_groups import LABELS
from dpcli.cli.prepare.conversion import ConversionOptions, run_conversion
from dpcli.cli.prepare.lists import words
from dpcli.cli.prepare.options import LabelTable, Pattern, Stride, Topic
from dpcli.errors import UsageError

if TYPE_CHECKING:
    from dpcli.prepare.scans.array_sequences import ArraySequences
    from dpcli.prepare.scans.clouds import CloudFolders
    from dpcli.prepare.scans.recorded_clouds import RecordedClouds
    from dpcli.prepare.scans.tables import TableSequences
    from dpcli.prepare.scans.tracked_points import TrackedViews


@dataclass(frozen=True)
class CloudUnits:
    """Holds the options that say what the numbers in the files mean."""

    bin_columns: Annotated[
        int | None,
        typer.Option(
            "--bin-columns", help="float32 values per point of a .bin. Default: judged by the values, else 4."
        ),
    ] = None
    axes: Annotated[
        str,
        typer.Option(
            "--axes",
            help="Axes of one array of many clouds: T frames, N points, C x y z, B sequences, as in TNC. Default: by shape and"
            " values.",
        ),
    ] = ""
    scale: Annotated[
        float | None,
        typer.Option("--scale", help="Input units per unit of length in the output. Default: the files', else 1."),
    ] = None
    unit: Annotated[str, typer.Option("--unit", help="Name of the output's unit of length.")] = "m"
    keep_fields: Annotated[
        str, typer.Option("--keep-fields", metavar="A,B", help="Further columns to keep, as field_A, field_B.")
    ] = ""

    track: Annotated[
        str,
        typer.Option(
            "--track",
            metavar="COLUMN|rows|columns",
            help="What tells which points of two frames are one: a column; rows where each frame lists the same points in"
            " the same order; columns where a table's row is a frame and three columns each a point. Default: nothing;"
            " motions are searched.",
        ),
    ] = ""

    @property
    def kept(self) -> tuple[str, ...]:
        """Returns the names of the columns to keep, in their order, each once."""
        return tuple(dict.fromkeys(words(self.keep_fields)))


@dataclass(frozen=True)
class TableColumns:
    """Holds the options of tables whose rows are the points of many frames."""

    HEADING: ClassVar[str] = "Tables"
    frame_column: Annotated[
        str, typer.Option("--frame-column", help="Column that numbers the frames of a table. Default: by its name.")
    ] = ""
    sequence_column: Annotated[
        str, typer.Option("--sequence-column", help="Column that names the sequences of a table.")
    ] = ""
    gap: Annotated[
        float | None,
        typer.Option("--gap", help="A jump of more than this between frame numbers, or a fall, begins a sequence."),
    ] = None


def clouds(
    raw: Annotated[
        Path,
        typer.Argument(
            help="Folder of .ply .pcd .las .laz .npy .npz .bin .csv .xyz frames, or of such; a table; an array of many"
            " clouds (.npy .npz .h5 .mat); a recording; or a views file with true tracks."
        ),
    ],
    units: CloudUnits,
    table: TableColumns,
    *,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second; writes the time of every frame.")
    ] = None,
    stride: Stride = 1,
    pattern: Pattern = "",
    topic: Topic = "",
    label_from_folder: Annotated[
        bool,
        typer.Option(
            "--label-from-folder",
            rich_help_panel=LABELS,
            help="Take labels from folders RAW/CLASS/SEQUENCE/frames, or RAW/train/CLASS/... and RAW/test/CLASS/...",
        ),
    ] = False,
    labels: LabelTable = None,
    conversion: ConversionOptions,
) -> None:
    """Read point cloud files: a folder is a sequence, its files are the frames; or tables with a column of frames,
    or a topic of a robot's recording.

    For example: dpc prepare clouds scans --fps 10 -o own.h5
    """
    shared = {
        "scale": units.scale,
        "unit": units.unit,
        "keep": units.kept,
        "track": units.track,
        "fps": fps,
        "stride": stride,
        "label_from_folder": label_from_folder,
        "labels": labels,
    }
    run_conversion("clouds", lambda: _make_reader(raw, units, table, pattern, topic, shared), conversion, raw)


def _make_reader(
    raw: Path, units: CloudUnits, table: TableColumns, pattern: str, topic: str, shared: dict[str, Any]
) -> ArraySequences | CloudFolders | TableSequences | RecordedClouds | TrackedViews:
    """Returns the reader of recordings, of tables (those of a folder where an option says so), of arrays of many clouds, or of
    folders of frames.
    """
    from dpcli.prepare.array_files.containers import made_by_dpc
    from dpcli.prepare.decode.cloud_files import SUFFIXES
    from dpcli.prepare.named_columns import holds_table
    from dpcli.prepare.recordings.recording import holds_only_recordings
    from dpcli.prepare.scans.array_sequences import ArraySequences, holds_sequences
    from dpcli.prepare.scans.clouds import CloudFolders
    from dpcli.prepare.scans.recorded_clouds import RecordedClouds
    from dpcli.prepare.scans.tables import TABLES, TableSequences
    from dpcli.prepare.scans.tracked_points import TrackedViews
    from dpcli.prepare.wide_tables import COLUMNS
    from dpcli.store.file import file_kind

    if made_by_dpc(raw) and file_kind(raw) == "views":
        if units.axes or units.bin_columns or pattern or topic or table != TableColumns():
            raise UsageError(
                f"{raw}: holds views, whose tracks are read as they are; leave out --axes, --bin-columns, --pattern, --topic and"
                " the options of tables"
            )
        return TrackedViews(raw, **shared)
    if topic or holds_only_recordings(raw, SUFFIXES):
        return RecordedClouds(raw, topic=topic, **shared)
    of_tables = table != TableColumns() or (units.track == COLUMNS and raw.is_dir())
    is_table = raw.is_file() and (raw.suffix.lower() in TABLES or not units.axes and holds_table(raw))
    if of_tables or is_table:
        return TableSequences(raw, **vars(table), **shared)
    if units.axes or holds_sequences(raw, SUFFIXES):
        return ArraySequences(raw, axes=units.axes, pattern=pattern, **shared)
    return CloudFolders(raw, bin_columns=units.bin_columns, pattern=pattern, **shared)
