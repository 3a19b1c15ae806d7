"""Containers: files that hold several streams and their own description, as a bag, an HDF5 file or an XDF file.

A container is read by a `tacpipe.formats.containers.container.Container`, which a format implements: its episodes, what a
look at it shows, and the streams of one episode read in one pass. Each stream comes as a `SourceStream`: its name inside the
file (``source``), a name for the stream, where its stamps are (`Time`), and rows whose fields have type, quantity, unit
and layout in their metadata: a table, or `Batched`, of which memory holds some at a time. What cannot be read is named with
a reason in `Contents.skipped`, what is missing of a damaged file in `Contents.notes`, and what the file states of itself
becomes `Contents.attributes`.

The layout file of ``ingest table`` is applied to that: a stream of a layout names the container's with ``source``; rules of
``columns`` and ``time`` replace what the file declares, and are left out where it is right. A new format is

1. a module with ``opened(path) -> Container``, which imports its library inside functions;
2. an entry in `tacpipe.formats.containers.container.KINDS`, and its name in `Format` of ``tacpipe/formats/table/layout.py``;
3. a stage, made by `tacpipe.formats.table.contained.ContainerCommand`, with an entry point ``tacpipe.formats``.
"""
