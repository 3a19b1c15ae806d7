"""Keep the attributes of results that state the published set of recordings, and whether they were simulated.

``tacpipe ingest`` marks the recordings of a published set with the name of its format. What a paper printed stands next to
results on its own data alone, and a lab's own recordings have no such mark.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from tacpipe.plugins.stage import Attribute

PUBLISHED, SIMULATED = "published", "simulated"


def combined(recordings: Iterable[Mapping[str, Attribute]]) -> dict[str, Attribute]:
    """Return the attributes of a result of several recordings: simulated if any is, published if all are.

    >>> combined([{"published": "b"}, {"published": "a"}]), combined([{"published": "a"}, {"simulated": True}])
    ({'published': 'a,b'}, {'simulated': True})
    """
    attributes = list(recordings)
    origin: dict[str, Attribute] = (
        {SIMULATED: True} if any(recording.get(SIMULATED) for recording in attributes) else {}
    )
    sets = {str(recording.get(PUBLISHED) or "") for recording in attributes}
    if sets and "" not in sets:
        origin[PUBLISHED] = ",".join(sorted(sets))
    return origin
