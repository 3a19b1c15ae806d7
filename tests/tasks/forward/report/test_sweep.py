"""Check the losses of codecs, by kind and width."""

from tacpipe.tasks.forward.report import representations
from tests.tasks.forward.report.result_fakes import codec, result


def test_codecs_are_read_once_each_wherever_they_lie() -> None:
    with_codec = result()
    with_codec.files["codec.json"] = codec(8).files["codec.json"]
    assert [
        codec_read["latents"] for codec_read in representations.read_codecs([with_codec, codec(8), result(), codec(4)])
    ] == [8, 4]


def test_losses_of_one_width_are_averaged_and_series_are_kept_apart() -> None:
    codecs = representations.read_codecs(
        [
            codec(8, loss=0.5),
            codec(8, loss=0.25),
            codec(4),
            codec(8, "autoencoder", frames=2),
            codec(8, of="increments"),
        ]
    )
    losses = {(loss.series, loss.latents): loss for loss in representations.codec_losses(codecs)}
    assert set(losses) == {("PCA", 8), ("PCA", 4), ("AE-C2", 8), ("PCA increments", 8)}
    assert losses["PCA", 8].codecs == 2
    assert losses["PCA", 8].mse_standardised == 0.375
    assert losses["PCA", 8].mae_counts == 7.5
    assert losses["PCA", 8].part == "val"


def test_losses_are_of_the_fits_own_rows_where_one_codec_held_none_out() -> None:
    fitted = codec(8, reconstruction={"train": {"rows": 1, "mse_standardised": 0.125, "mae_counts": 1.0}})
    losses = representations.codec_losses(representations.read_codecs([fitted, codec(4, loss=0.5)]))
    assert [(loss.latents, loss.part, loss.mse_standardised) for loss in losses] == [
        (4, "train", 0.25),
        (8, "train", 0.125),
    ]


def test_the_papers_codec_is_the_one_of_the_nearest_width() -> None:
    paper_codec = representations.paper_codec(
        representations.read_codecs([codec(8), codec(16), codec(20, "autoencoder")]), "PCA", 20
    )
    assert paper_codec is not None and paper_codec["latents"] == 16
    assert representations.paper_codec([], "PCA", 20) is None
