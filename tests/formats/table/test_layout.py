import pytest

from tacpipe.errors import UsageError
from tacpipe.formats.table import layout
from tests.formats.table import labs

STREAM = '[streams.skin]\nfiles = "{trial}.csv"\ntime = { column = "t" }\ncolumns = [{ match = "x" }]\n'
WRONG = {  # a layout, and what the sentence about it must name
    "": ("stream",),
    "x = [": ("TOML",),
    "[stream.skin]": ("stream", "streams"),
    "[streams.skin]\nfiles = 'x'": ("[streams.skin]", "time"),
    STREAM.replace("column =", "colunm ="): ("[streams.skin]", "colunm", "column"),
    STREAM.replace('column = "t"', 'column = "t", unit = "h"'): ("[streams.skin]", "unit", "'h'", "iso8601"),
    STREAM.replace('column = "t"', 'column = "t", sort = true, split_at_reset = true'): ("[streams.skin]", "time.sort"),
    STREAM.replace('column = "t"', "rate_hz = 5, sort = true"): ("[streams.skin]", "sort"),
    STREAM.replace('column = "t"', 'column = "t", zone = "Mars"'): ("[streams.skin]", "zone", "Mars"),
    STREAM.replace('column = "t"', "rate_hz = -5"): ("[streams.skin]", "rate_hz", "-5"),
    STREAM.replace('match = "x"', 'match = "x", type = "uint12"'): ("columns 1", "uint12"),
    STREAM.replace('match = "x"', 'match = "x", name = "{taxel}"'): ("{taxel}",),
    STREAM.replace('match = "x"', 'match = "x", quantity = "?"'): ("quantity", "?"),
    STREAM.replace('match = "x"', 'match = "x", quantity = "tactle"'): (
        "columns 1",
        "tactle",
        "tactile",
        "[vocabulary]",
    ),
    STREAM.replace('match = "x"', 'match = "x", unit = "Newton"'): ("columns 1", "Newton", "Did you mean N", "units"),
    STREAM + '[vocabulary]\nquantity = ["x"]': ("[vocabulary]", "quantity", "quantities"),
    STREAM.replace("{trial}", "{trial"): ("{trial", "brace"),
    STREAM + 'separator = ",,"\n': ("separator", ",,"),
    STREAM + '[recordings]\nname = "{subject}"': ("{subject}", "trial"),
    STREAM + '[[labels]]\nfile = "labels.csv"': ("labels.csv", "key"),
    STREAM + "[attributes]\nlist = [1]": ("list", "[1]"),
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_layout_is_one_sentence_with_its_entry(text: str) -> None:
    with pytest.raises(UsageError) as result:
        layout.parse_layout(text, "layout.toml")
    assert all(part in str(result.value) for part in ("", *WRONG[text])), str(result.value)
    assert "\n" not in str(result.value)


def test_placeholders_that_all_streams_share_make_a_recording() -> None:
    text = STREAM + STREAM.replace("skin", "arm").replace("{trial}.csv", "{arm}/{trial}.csv")
    assert layout.parse_layout(text).placeholders == ("trial",)


def test_the_format_follows_the_extension_unless_the_layout_names_one() -> None:
    from pathlib import Path

    stream = labs.stream()
    assert [stream.format_of(Path(name)) for name in ("a.TSV", "a.csv.gz", "a.parquet", "a.jsonl")] == [
        "csv",
        "csv",
        "parquet",
        "jsonl",
    ]
    assert labs.stream('format = "csv"').format_of(Path("a.log")) == "csv"
    with pytest.raises(UsageError, match=r"a\.log"):
        stream.format_of(Path("a.log"))


def test_a_quantity_and_a_unit_of_ones_own_are_read_where_the_layout_declares_them() -> None:
    local = STREAM.replace('match = "x"', 'match = "x", quantity = "glow", unit = "blink"')
    for declared in ("", '[vocabulary]\nquantities = ["glow"]'):
        with pytest.raises(UsageError, match="blink" if declared else "glow"):
            layout.parse_layout(local + declared)
    output = layout.parse_layout(local + '[vocabulary]\nquantities = ["glow"]\nunits = ["blink"]')
    assert (output.streams[0].columns[0].quantity, output.streams[0].columns[0].unit) == ("glow", "blink")
