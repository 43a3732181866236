"""A reader parses every sentence of README and the guides at once: few words, few figures."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LONGEST, MOST_FIGURES = 35, 2
BACKGROUND = {"method.md", "decisions.md"}  # for those who change the code
PAGES = [ROOT / "README.md"] + [
    p for p in sorted((ROOT / "docs").glob("*.md")) if p.name not in BACKGROUND
]
BLOCK = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
# A number by itself: not the 3 of R³, of 2x, of Y_5 or of a date.
FIGURE = re.compile(r"(?<![\w.,^/−-])\d[\d,]*(?:\.\d+)?(?:e[-−]?\d+)?(?![\w²³°]*[^\W\d_])")
UNCLEAR = re.compile(r"\bbut for\b|\bof that\b|\bby either\b", re.IGNORECASE)


def sentences(text):
    """The sentences outside of code, tables and headings; a link is its words, inline code is one word."""
    text = BLOCK.sub("\n\n", text)
    text = re.sub(r"^(\||#).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "CODE", text)
    text = re.sub(r"\d{4}-\d{2}-\d{2}", "DATE", text)
    # "order 3" is a name and "= 0" a part of a formula: no figures.
    text = re.sub(r"(?i)\b(orders?|dimensions?) \d( (and|or|to) \d)?", r"\1", text)
    text = re.sub(r"= \d\b(?![.,]\d)", "=", text)
    for paragraph in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) ", text):
        yield from re.split(r"(?<=[.!?])[*_)]*\s+(?=[^a-z\s])", " ".join(paragraph.split()))


def faults(text):
    """Sentences that are hard to parse, each with the reason."""
    for sentence in sentences(text):
        words = [word for word in sentence.split() if re.search(r"\w", word)]
        figures = FIGURE.findall(sentence)
        if len(words) > LONGEST:
            yield f"{len(words)} words: {sentence}"
        if len(figures) > MOST_FIGURES:
            yield f"{len(figures)} figures: {sentence}"
        if found := UNCLEAR.search(sentence):
            yield f"“{found.group()}”: {sentence}"


def test_what_counts():
    long = "word " * LONGEST + "and more."
    assert [fault.split(":")[0] for fault in faults(long)] == ["37 words"]
    assert [fault.split(":")[0] for fault in faults("It is 1, 2.5 or 3e-4.")] == ["3 figures"]
    page = "| 1 | 2 | 3 |\n\n```python\n1, 2, 3\n```\n\nIn R³ at order 3, on 2026-01-02, `1 2 3`."
    assert not list(faults(page))
    assert list(sentences("One. Two three.\n- Four")) == ["One.", "Two three.", "Four"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_sentences_of_a_page_are_short(page):
    assert not list(faults(page.read_text("utf-8")))
