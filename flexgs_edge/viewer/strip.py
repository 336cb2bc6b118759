"""Leave out of JavaScript what only readers need: comments, indentation and spaces. Names stay."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

_SPACE = re.compile(r"(?:\s+|//[^\n]*|/\*.*?\*/)+", re.DOTALL)
_TEXT = re.compile(r"'(?:[^'\\\n]|\\.)*'|\"(?:[^\"\\\n]|\\.)*\"")
_WORD = re.compile(r"#?[A-Za-z_$][\w$]*", re.ASCII)
_NUMBER = re.compile(r"(?:0[xXbBoO][\da-fA-F_]+|(?:\d[\d_]*\.?[\d_]*|\.\d[\d_]*)(?:[eE][-+]?\d+)?)n?", re.ASCII)
_PATTERN = re.compile(r"/(?:[^/\\\[\n]|\\.|\[(?:[^\]\\\n]|\\.)*\])+/[a-z]*")
_TEMPLATE = re.compile(r"(?:[^`\\$]|\\.|\$(?!\{))*(`|\$\{)", re.DOTALL)
_SIGN = re.compile(
    r">>>=|\.\.\.|===|!==|\*\*=|<<=|>>=|>>>|&&=|\|\|=|\?\?=|=>|==|!=|<=|>=|&&|\|\||\?\?|\?\.(?!\d)|\+\+|--|\+=|-=|\*=|/=|%=|"
    r"&=|\|=|\^=|<<|>>|\*\*|[-{}()\[\];,<>+*/%&|^!~?:=.]"
)
_BEFORE_PATTERN = frozenset(
    (
        "return",
        "typeof",
        "case",
        "in",
        "of",
        "delete",
        "void",
        "throw",
        "new",
        "instanceof",
        "do",
        "else",
        "yield",
        "await",
    )
)
_HEADS = frozenset(("if", "while", "for", "with"))
_ENDS = frozenset((")", "]", "}", "++", "--"))
"""Signs that may end a statement without a semicolon."""
_STARTS = frozenset(("{", "!", "~", "++", "--", "...", "*"))
"""Signs that may start one."""
_LINE_ENDS = frozenset(("return", "break", "continue", "throw", "yield", "async"))
"""Words after which the end of a line means something."""
_GLSL = "`#version"


class Token(NamedTuple):
    """A piece of a script, and what stood before it.

    Parameters
    ----------
    kind : str
        `word`, `number`, `text`, `pattern`, `template` or `sign`.
    text : str
    gap : str
        Nothing, a space, or the end of a line.
    """

    kind: str
    text: str
    gap: str


def tokens_of(script: str) -> list[Token]:
    """The tokens of a script.

    Raises
    ------
    ValueError
        For what no token begins with, and for a slash of which it cannot be told whether it divides or starts a pattern.
    """
    return list(_Reader(script).read())


class _Reader:
    def __init__(self, script: str) -> None:
        self.script = script
        self.at = 0
        self.last = Token("", "", "")
        self.open: list[str] = []
        """For each open bracket the word before it; `${` for a part of a template."""

    def read(self) -> Iterator[Token]:
        while True:
            gap = ""
            if found := _SPACE.match(self.script, self.at):
                gap = "\n" if "\n" in found[0] else " "
                self.at = found.end()
            if self.at == len(self.script):
                if self.open:
                    raise ValueError(f"a script ends within {self.open[-1] or 'a bracket'!r}")
                return
            kind, text = self._next()
            self.at += len(text)
            closed = self._brackets(kind, text)
            self.last = Token(kind, text, closed)
            yield Token(kind, text, gap)

    def _next(self) -> tuple[str, str]:
        script, at = self.script, self.at
        letter = script[at]
        if letter == "`" or (letter == "}" and self.open and self.open[-1] == "${"):
            found = _TEMPLATE.match(script, at + 1)
            if found is None:
                raise ValueError(f"a template without an end: {self._here()}")
            return "template", letter + found[0]
        if letter == "/" and self._pattern_may_start():
            return "pattern", self._match(_PATTERN)
        for kind, expression in (("text", _TEXT), ("word", _WORD), ("number", _NUMBER), ("sign", _SIGN)):
            if found := expression.match(script, at):
                return kind, found[0]
        raise ValueError(f"no token begins so: {self._here()}")

    def _match(self, expression: re.Pattern[str]) -> str:
        found = expression.match(self.script, self.at)
        if found is None:
            raise ValueError(f"a pattern without an end: {self._here()}")
        return found[0]

    def _here(self) -> str:
        return repr(self.script[self.at : self.at + 40])

    def _pattern_may_start(self) -> bool:
        kind, text, closed = self.last
        if kind == "word":
            return text in _BEFORE_PATTERN
        if kind == "sign" and text == "}":
            raise ValueError(f"cannot tell whether this divides: {self._here()}")
        if kind == "sign" and text == ")":
            return closed in _HEADS
        if kind == "template":
            return text.endswith("${")
        return kind == "" or (kind == "sign" and text not in _ENDS)

    def _brackets(self, kind: str, text: str) -> str:
        """Keep account of brackets; returns the word before the one that this token closes."""
        if kind == "template":
            if text[0] == "}":
                self.open.pop()
            if text.endswith("${"):
                self.open.append("${")
        elif kind == "sign" and text in ("(", "[", "{"):
            self.open.append(self.last.text if self.last.kind == "word" else "")
        elif kind == "sign" and text in (")", "]", "}"):
            if not self.open:
                raise ValueError(f"nothing to close: {self._here()}")
            return self.open.pop()
        return ""


def strip_script(script: str) -> str:
    """The script without comments and without the spaces that it can do without.

    Every token stays as it is, but for shaders: a template that begins with `#version` loses comments and indentation.
    Ends of lines stay where a semicolon might be missing.

    Raises
    ------
    ValueError
        As `tokens_of`.
    """
    tokens = [
        Token(kind, _shader(text) if text.startswith(_GLSL) else text, gap) for kind, text, gap in tokens_of(script)
    ]
    parts: list[str] = []
    before: Token | None = None
    for token in tokens:
        if before is not None:
            parts.append(_between(before, token))
        parts.append(token.text)
        before = token
    made = "".join(parts)
    if [token.text for token in tokens_of(made)] != [token.text for token in tokens]:
        raise AssertionError("a script that says something else without its spaces")
    return made


def _shader(text: str) -> str:
    return re.sub(r"\n\s+", "\n", re.sub(r"[ \t]*//[^\n]*", "", text))


def _between(before: Token, token: Token) -> str:
    if token.gap == "\n":
        may_end = before.kind != "sign" or before.text in _ENDS
        may_start = token.kind not in ("sign", "template") or token.text in _STARTS
        if (may_end and may_start) or before.text in _LINE_ENDS:
            return "\n"
    return " " if token.gap and _meet(before, token) else ""


def _meet(before: Token, token: Token) -> bool:
    """Whether two tokens would become another one, or the end of a script's element."""
    both = before.text[-1] + token.text[0]
    if re.fullmatch(r"[\w$][\w$#]", both, re.ASCII):
        return True
    if before.kind == "number" and token.text[0] == ".":
        return True
    if both in ("//", "/*", "</", "<!") or (before.text == "--" and token.text[0] == ">"):
        return True
    if before.kind == token.kind == "sign":
        found = _SIGN.match(before.text + token.text)
        return found is None or found[0] != before.text
    return before.kind == "sign" and before.text == "." and token.kind == "number"
