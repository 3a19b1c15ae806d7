"""What TensorBoard's own reader finds in the event files of a folder, as JSON: run in the environment of the trackers."""

from __future__ import annotations

import json
import sys

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

found = EventAccumulator(sys.argv[1])
found.Reload()
scalars = {tag: [(event.step, event.value) for event in found.Scalars(tag)] for tag in found.Tags()["scalars"]}
texts = {
    tag: [value.tensor_proto.string_val[0].decode() for value in found.Tensors(tag)] for tag in found.Tags()["tensors"]
}
plugins = found.summary_metadata
hyper = any(one.plugin_data.plugin_name == "hparams" for one in plugins.values())
print(json.dumps({"scalars": scalars, "texts": texts, "hparams": hyper}))
