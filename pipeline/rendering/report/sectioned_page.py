"""Page of answers and sections with sentences, figures and tables. It is one file, has no script, and loads nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

from pipeline.base.provenance import __version__
from pipeline.base.wording import true_minus, unbroken
from pipeline.rendering.figures.drawing import Figure, draw
from pipeline.rendering.report.page_template import fill_template
from pipeline.rendering.table import Table, marked


@dataclass(frozen=True, eq=False)
class Section:
    """Section of a page with an identifier, a heading, sentences, figures and tables.

    Absent tables are None and are left out.
    """

    identifier: str
    heading: str
    sentences: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table | None] = ()


@dataclass(frozen=True, eq=False)
class SectionedPage:
    """Content of a page.

    Parameters
    ----------
    title, lead : str
        Heading of the page, and the sentence below it.
    answers : sequence of (str, str)
        Short answers, each with its topic.
    warnings : sequence of str
    sections : sequence of Section
    simulated : bool
        Whether a log is simulated, which the page, its figures and its tables state.
    """

    title: str
    lead: str
    answers: Sequence[tuple[str, str]]
    warnings: Sequence[str]
    sections: Sequence[Section]
    simulated: bool = False


def render(page: SectionedPage) -> str:
    """Return a page as one HTML document. Figures are numbered in their order."""
    numbers = count(1)
    sections = [
        {
            "section": section,
            "sentences": [true_minus(sentence) for sentence in section.sentences],
            "figures": [(draw(replace(figure, simulated=page.simulated)), next(numbers)) for figure in section.figures],
            "tables": [marked(table, simulated=page.simulated) for table in section.tables if table is not None],
        }
        for section in page.sections
    ]
    answers = [(topic, true_minus(text)) for topic, text in page.answers]
    content = {"page": page, "answers": answers, "sections": sections, "version": __version__}
    return unbroken(fill_template("sectioned_page.html.j2", **content))
