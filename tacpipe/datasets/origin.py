"""Which published set a recording is of, and whether it was simulated: attributes that results carry on.

``tacpipe ingest`` marks the recordings of a published set with the name of its format. What a paper printed stands next to
results on its own data alone, and a lab's own recordings have no such mark.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from tacpipe.plugins.stage import Attribute

PUBLISHED, SIMULATED = "published", "simulated"


def together(recordings: Iterable[Mapping[str, Attribute]]) -> dict[str, Attribute]:
    """Return the attributes of what several recordings led to, given theirs: simulated if any is, published if all are.

    >>> together([{"published": "b"}, {"published": "a"}]), together([{"published": "a"}, {"simulated": True}])
    ({'published': 'a,b'}, {'simulated': True})
    """
    every = list(recordings)
    found: dict[str, Attribute] = {SIMULATED: True} if any(one.get(SIMULATED) for one in every) else {}
    sets = {str(one.get(PUBLISHED) or "") for one in every}
    if sets and "" not in sets:
        found[PUBLISHED] = ",".join(sorted(sets))
    return found
