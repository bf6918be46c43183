"""Pages for readers are short sentences, short paragraphs and few numbers; pages of Start and Explanation have pictures.

Results and notes are free. The limits are a little above what the pages aim at: a median of 12 words a sentence, nine in
ten within 24, 4 numbers in 100 words.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
FREE = ("results", "notes")
PAGES = [
    README,
    *(p for p in sorted((ROOT / "docs").rglob("*.md")) if p.parent.name not in FREE),
]
MEDIAN, NINE_IN_TEN, NUMBERS, PARAGRAPH, WORDS = 14, 28, 5, 100, 900


def paragraphs(text: str) -> list[str]:
    """Running text: no code, tables, headings or pictures; links and code are their words."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    found = []
    for block in re.split(r"\n\s*\n", text):
        lines = [line for line in block.splitlines() if not re.match(r"\s*([|#<]|!\[)|    ", line)]
        words = re.sub(r"`[^`]*`", "code", " ".join(lines))
        found.append(re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", words))
    return [one for one in found if one.strip()]


def faults(text: str) -> list[str]:
    """What is too long, or too full of numbers."""
    blocks = paragraphs(text)
    sentences = [s for block in blocks for s in re.split(r"(?<=[.!?:])\s+|\s[*-]\s", block)]
    lengths = sorted(len(s.split()) for s in sentences if len(s.split()) > 2)
    words = sum(len(block.split()) for block in blocks)
    numbers = sum(len(re.findall(r"(?<![\w.])\d[\d.,%]*", block)) for block in blocks)
    found = [
        f"paragraph of {len(b.split())} words: {b[:60]}"
        for b in blocks
        if len(b.split()) > PARAGRAPH
    ]
    if lengths and lengths[len(lengths) // 2] > MEDIAN:
        found.append(f"median sentence of {lengths[len(lengths) // 2]} words")
    if lengths and lengths[int(0.9 * len(lengths))] > NINE_IN_TEN:
        found.append(f"one sentence in ten of {lengths[int(0.9 * len(lengths))]} words or more")
    if words and 100 * numbers / words > NUMBERS:
        found.append(f"{100 * numbers / words:.1f} numbers in 100 words")
    return found


def pictures(text: str) -> list[str]:
    return re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_pages_read_well(page):
    assert not faults(page.read_text())


@pytest.mark.parametrize(
    "page",
    [p for p in PAGES if p.parent.name in ("start", "explanation")],
    ids=lambda p: p.relative_to(ROOT).as_posix(),
)
def test_pages_to_learn_from_have_pictures(page):
    assert pictures(page.read_text())


def test_the_readme_is_short_and_moves_in_its_first_screen():
    text = README.read_text()
    first = "\n".join(text.splitlines()[:20])
    moving = [one for one in pictures(first) if one.endswith((".webp", ".gif"))]
    assert sum(len(block.split()) for block in paragraphs(text)) < WORDS
    assert moving and (ROOT / moving[0]).stat().st_size < 1_500_000
    assert b"ANIM" in (ROOT / moving[0]).read_bytes()[:100]
    assert "    make sample" in first and "## Citation" in text and "## Licence" in text


def test_the_checks_see_faults():
    short = "A short sentence stands here. Another one follows it.\n\n"
    assert not faults(short)
    long = "This sentence " + "goes on and on " * 9 + "to its end. "
    assert "median" in faults(long)[0] and "one sentence in ten" in faults(long)[1]
    assert "paragraph" in faults(short + long * 3)[0]
    assert "numbers" in faults("There are 3 of 4 and 5.\n")[0]
    assert not faults("```\n" + long * 9 + "\n```\n\n| " + long * 9 + "|\n\n    " + long * 9)
    assert pictures("![](a.png) [x](b.png) ![c](c.png)") == ["c.png"]
