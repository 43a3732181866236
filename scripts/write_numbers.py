"""The table of numbers in docs/method.md, from the source: python scripts/write_numbers.py.

A number that is set by hand stands at the head of a module, with a docstring below it; what follows from others is no
such number, and is not in the table.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "method.md"
MARKS = "<!-- numbers -->\n", "<!-- end of the numbers -->\n"


def is_number(node: ast.expr) -> bool:
    """Whether an expression is a number, or a tuple or table of numbers, that follows from no other."""
    match node:
        case ast.Constant(value=value):
            return type(value) in (int, float)
        case ast.UnaryOp(operand=part) | ast.Call(args=[part]):
            return is_number(part)
        case ast.BinOp(left=one, right=other):
            return is_number(one) and is_number(other)
        case ast.Tuple(elts=parts) | ast.Dict(values=parts):
            return all(is_number(part) for part in parts)
        case _:
            return False


def rows() -> Iterator[tuple[str, str, str]]:
    """(module and names, values, what they are) of every number, by module."""
    for path in sorted((ROOT / "torchlb").rglob("*.py")):
        body = ast.parse(path.read_text("utf-8")).body
        module = ".".join(path.relative_to(ROOT / "torchlb").with_suffix("").parts)
        for node, after in zip(body, [*body[1:], None], strict=True):
            if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
                continue
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            names = ast.unparse(target).strip("()")
            if not names.isupper() or not is_number(node.value):
                continue
            match after:
                case ast.Expr(value=ast.Constant(value=str(words))):
                    value = ast.unparse(node.value).strip("()" if "," in names else "")
                    yield f"`{module}`: `{names}`", f"`{value}`", " ".join(words.split())
                case _:
                    raise SystemExit(f"{path}: {names} has no docstring")


def table() -> str:
    """The table, as Markdown."""
    lines = ["number | value | what it is", ":--|:--|:--"]
    lines += [" | ".join(cell.replace("|", "\\|") for cell in cells) for cells in rows()]
    return "".join(f"| {line} |\n" for line in lines)


def with_table(page: str) -> str:
    """A page with the table between its marks."""
    before, _, rest = page.partition(MARKS[0])
    after = rest.partition(MARKS[1])[2]
    return f"{before}{MARKS[0]}\n{table()}\n{MARKS[1]}{after}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text("utf-8")), "utf-8")
