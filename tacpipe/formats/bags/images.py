"""Declare the images in messages of ROS and Foxglove, so that they become streams of frames."""

from __future__ import annotations

import pyarrow as pa
import pyarrow.compute as pc

from tacpipe.formats.container import Batched
from tacpipe.video.images import PICTURE, RAW_FORMATS, raw_format

COMPRESSED = "CompressedImage"
RAW = ("Image", "RawImage")
LAYOUT = ("height", "width", "encoding", "is_bigendian", "step")  # columns of raw images; Foxglove has no is_bigendian


def declare_images(content: Batched, message_type: str) -> Batched:
    """Return the rows of a topic with the quantity image at the data of image messages.

    Padding is removed from raw images, and columns that describe them become metadata, if all images are equal in
    format and can be decoded. Otherwise rows are unchanged.
    """
    name = message_type.replace(".", "/").rpartition("/")[2]
    schema = content.schema
    if PICTURE not in schema.names or not pa.types.is_binary(schema.field(PICTURE).type):
        return content
    if name == COMPRESSED:
        return _add_metadata(content, {"quantity": "image"})
    return _raw_images(content) if name in RAW else content


def _add_metadata(content: Batched, metadata: dict[str, str], omitted_columns: tuple[str, ...] = ()) -> Batched:
    """Return rows with metadata at the images and without some columns."""
    fields = {field.name: field for field in content.schema if field.name not in omitted_columns}
    image = fields[PICTURE]
    return content.with_fields({**fields, PICTURE: image.with_metadata({**(image.metadata or {}), **metadata})})


def _raw_images(content: Batched) -> Batched:
    """Return rows of raw images with their format as metadata and without padding.

    If the images differ in layout or their encoding cannot be decoded, the rows are returned unchanged.
    """
    present = [name for name in LAYOUT if name in content.schema.names]
    if not {"height", "width", "encoding", "step"} <= set(present):
        return content
    layouts, sizes = set(), set()
    for table in content.read():
        layouts |= {
            tuple(layout.values()) for layout in table.select(present).group_by(present).aggregate([]).to_pylist()
        }
        sizes |= set(pc.unique(pc.binary_length(table.column(PICTURE))).to_pylist())
    if len(layouts) != 1:
        return content
    layout = dict(zip(present, layouts.pop(), strict=True))
    width, height, step = int(layout["width"]), int(layout["height"]), int(layout["step"])
    video_format = raw_format(layout["encoding"], width, height, big_endian=bool(layout.get("is_bigendian")))
    if video_format is None:
        return content
    row_bytes = width * RAW_FORMATS[layout["encoding"]][1]
    if step < row_bytes or sizes != {step * height}:
        return content
    with_format = _add_metadata(content, video_format.to_metadata(), tuple(present))
    if step == row_bytes:
        return with_format

    def remove_padding(table: pa.Table) -> pa.Table:
        images = [
            b"".join(image[start : start + row_bytes] for start in range(0, step * height, step))
            for image in table.column(PICTURE).to_pylist()
        ]
        index = table.schema.get_field_index(PICTURE)
        return table.set_column(index, table.schema.field(index), pa.array(images, pa.binary()))

    return with_format.mapped(with_format.schema, remove_padding)
