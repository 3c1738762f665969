from __future__ import annotations

from hsloc.text_table import table


def test_table_is_markdown_in_columns() -> None:
    lines = table(("name", "n"), [("long name", "1"), ("b", "20")])
    assert lines == [
        "| name      |  n |",
        "|-----------|---:|",
        "| long name |  1 |",
        "| b         | 20 |",
        "",
    ]
