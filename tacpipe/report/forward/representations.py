"""What codecs hold and lose, drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tacpipe.report import markup
from tacpipe.report.forward import figures, sweep, tables

COMPONENTS = 40  # bars of the explained variance


def section(codecs: Sequence[sweep.Tree], published: bool) -> str:
    """Return what codecs hold and lose: variance, covariance, and loss by number of latents; empty without codecs.

    Where the data are ``published``, next to what the paper states of them.
    """
    found = sweep.losses(codecs)
    if not codecs:
        return ""
    drawn = []
    pca, autoencoder = sweep.papers(codecs, "PCA", 20), sweep.papers(codecs, "AE-C1", 8)
    if pca and pca.get("explained_ratio"):
        kept, ratio = int(pca["latents"]), pca["explained_ratio"]
        caption = (
            f"Variance by principal component{', as in Figure 4 of the paper' if published else ''}. The {kept} that are "
            f"kept hold {100 * sum(ratio[:kept]):.1f} %{'; in the paper 20 hold 82 %' if published else ''}."
        )
        drawn.append(markup.figure(figures.explained_variance(ratio[:COMPONENTS], kept), caption))
    for name, codec in (("PCA", pca), ("AE-C1", autoencoder)):
        if codec:
            caption = (
                f"Covariance between the {codec['latents']} latents of {name} on training rows; the colour's strength "
                f"is the square root of its size, blue above 0 and orange below."
            )
            drawn.append(markup.figure(figures.covariance(np.array(codec["latent_covariance"])), caption))
    series: dict[str, dict[int, float]] = {}
    for one in found:
        series.setdefault(one.series, {})[one.latents] = one.mse_standardised
    if any(len(widths) > 1 for widths in series.values()):
        caption = "Error of encoding and decoding, where 1 is what no latent at all would give. Lower is better."
        drawn.append(markup.figure(figures.loss_by_width(series), caption))
    rows = tables.losses(found) if found else ""
    return f'<h3>Representations</h3><div class="pair">{"".join(drawn)}</div>{rows}'
