"""Labels as LaTeX: what they may have in them, and which packages that needs.

pylatexenc has the table of Unicode and LaTeX; here is which of it pdflatex sets with the packages
that papers load anyway, tried character by character (tests/study/test_labels.py).
"""

import re
from functools import cache
from typing import Any

from mace_rl.config.section import ConfigError, short_repr

CYRILLIC = "\u0400-\u045f\u0490\u0491"
# In pylatexenc's table, but not in fonts of these packages.
UNSET = "ŉƕƞəɛɸʔʞΐϒЀЍѐѝ↜↝⇅⇵∟∯∰∱∻∾≆≋≌≙≛≸≹⊧⊨⊫⊶⊷⊹⊾⋘⋙⋨⋰"
NEEDS = (  # of the document that has such a label, by what is in it
    (rf"[{CYRILLIC}]", r"\usepackage[T2A,T1]{fontenc}"),
    ("[«»ÐÞðþĄąĐđĘęĮįŊŋŲų‚„‹›]", r"\usepackage[T1]{fontenc}"),
    ("[\u2100-\u22ff\u2011\u2035ϰ϶]", r"\usepackage{amsmath,amssymb}"),
)


@cache
def _encoder() -> Any:
    from pylatexenc import latexencode  # of the extra [study], as the tables are

    def in_its_encoding(found: re.Match[str]) -> str:
        return rf"{{\fontencoding{{T2A}}\selectfont {found[0]}}}"

    regex = latexencode.RULE_REGEX
    own = [
        (re.compile(f"[{CYRILLIC}]+"), in_its_encoding),
        (re.compile(r"\|"), lambda _: r"\textbar{}"),  # a dash in LaTeX's own fonts
    ]
    rule = latexencode.UnicodeToLatexConversionRule(regex, own)
    return latexencode.UnicodeToLatexEncoder(
        conversion_rules=[rule, "defaults"], unknown_char_policy="fail", unknown_char_warning=False
    )


def escaped(text: str) -> str:
    """`text` in LaTeX; `ValueError` for a character that it has not."""
    return str(_encoder().unicode_to_latex(text))


def packages(text: str) -> list[str]:
    """The lines that a document's preamble needs for a table with this text, not escaped."""
    cyrillic, other, symbols = ([line] * bool(re.search(found, text)) for found, line in NEEDS)
    return [r"\usepackage{booktabs}", *(cyrillic or other), *symbols]


def require_latex(text: str, key: str) -> None:
    """`ConfigError` for a text that cannot be set in LaTeX: table1.tex has it."""
    for character in text:
        try:
            escaped(character)
            known = character not in UNSET
        except ValueError:
            known = False
        if not known:
            raise ConfigError(
                f"{key} is {short_repr(text)}, but {character!r} is none of the letters and signs"
                " that LaTeX's usual fonts have"
            )
