"""Labels in LaTeX: whatever a configuration lets through, a real pdflatex sets."""

import pytest
from pydantic import ValidationError
from shared import NO_LATEX, pdflatex

from mace_rl.config.section import ConfigError
from mace_study.config.labels import escaped, packages, require_latex
from mace_study.config.study import ShownVariant


def allowed(label: str) -> bool:
    try:
        ShownVariant(label=label)
        require_latex(label, "label")
    except (ValidationError, ConfigError):
        return False
    return True


# Each between letters: a space or '_' at an end would be refused for that.
ALLOWED = [chr(code) for code in range(0x20, 0x3000) if allowed(f"a{chr(code)}b")]


def test_special_characters_are_escaped_once() -> None:
    assert escaped(r"a_b & 50 % β ~ \x {1} #2 $3^4") == (
        r"a\_b \& 50 \% \ensuremath{\beta} {\textasciitilde} {\textbackslash}x \{1\} \#2"
        r" \$3{\textasciicircum}4"
    )


def test_what_labels_may_have() -> None:
    assert len(ALLOWED) > 800
    for label in ("MACE, β ∈ [0, 1]", "∞ ≈ ≠ ⇒ ↔ √ ∑ ⊕ ∼", "Ά ώ Ω ς", "мера β", "½ × é ł ß «ж»"):
        assert allowed(label)
    for label in ("⋿", "ǆ", "ՙ", "漢", "ŉ"):
        assert not allowed(label)
    with pytest.raises(ConfigError, match=r"label is 'a ⋿', but '⋿' is none of the letters"):
        require_latex("a ⋿", "label")


@pytest.mark.slow
@pytest.mark.skipif(NO_LATEX, reason="needs pdflatex")
def test_pdflatex_sets_every_character_with_the_packages_that_are_named(tmp_path) -> None:
    groups: dict[tuple[str, ...], list[str]] = {}
    for character in ALLOWED:
        groups.setdefault(tuple(packages(character)), []).append(character)
    groups[tuple(packages("".join(ALLOWED)))] = ALLOWED
    assert len(groups) == 5
    for needed, characters in groups.items():
        body = "".join(f"\\hbox{{{escaped(f'a{character}b')}}}\n" for character in characters)
        assert "Missing character" not in pdflatex(tmp_path, needed, body)
