"""Print as JSON the content of event files that TensorBoard's own reader finds, in the environment of the trackers."""

from __future__ import annotations

import json
import sys

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

events = EventAccumulator(sys.argv[1])
events.Reload()
scalars = {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
texts = {
    tag: [value.tensor_proto.string_val[0].decode() for value in events.Tensors(tag)]
    for tag in events.Tags()["tensors"]
}
plugins = events.summary_metadata
hyper = any(plugin.plugin_data.plugin_name == "hparams" for plugin in plugins.values())
print(json.dumps({"scalars": scalars, "texts": texts, "hparams": hyper}))
