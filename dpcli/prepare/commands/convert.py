"""Raw data of any kind into one clouds file, read in processes of this machine or on a Dask cluster."""

from __future__ import annotations

from dpcli.prepare.pipeline import Conversion, Report, convert
from dpcli.prepare.reader import Reader
from dpcli.runtime.machines.dask_cluster import cluster_executor
from dpcli.store.pipes import output_file


def convert_raw_data(reader: Reader, output: str, conversion: Conversion, dask: str = "") -> Report:
    """Converts every item of a reader and return what was done; see `pipeline.convert` for errors.

    output: a path, or - for a pipe. dask: the address of a cluster's scheduler, `local` for one of its own, or "" for
    processes of this machine.
    """
    resume = output != "-"
    with output_file(output) as path:
        if not dask:
            return convert(reader, path, conversion, resume=resume)
        with cluster_executor(dask, conversion.processes) as (executor, slots):
            return convert(reader, path, conversion, executor=executor, slots=slots, resume=resume)
