"""What MkDocs does not do by itself for `make docs`.

The site has the places of the repository, with docs/ as its root: what a page links to outside of
docs/ becomes a file of the site under its own path, so that one link serves the repository and the
site. The README is its first page.
"""

import functools
import logging
import posixpath
import re
from pathlib import Path
from typing import Any, Final

from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

log = logging.getLogger("mkdocs.hooks.stewart_drake")  # a warning ends a strict build

ROOT: Final = Path(__file__).resolve().parents[1]
OUTSIDE: Final = ("CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "CITATION.cff")
FOLDERS: Final = ("benchmarks/results/*.*", "diagrams/*/*.*", "models/*.*", "analysis/*.*")
"""What else pages may link to."""
LINK: Final = re.compile(r"(\]\()([^)\s]+)(\))")
REMOTE: Final = re.compile(r"<(?:script|img|iframe|link rel=.stylesheet)[^>]*(?:src|href)=.https?:")


def on_files(files: Files, config: Any) -> Files:
    """Add the README and what stands outside of docs/."""
    found = sorted(path for pattern in FOLDERS for path in ROOT.glob(pattern))
    for path in (*OUTSIDE, *(str(path.relative_to(ROOT)) for path in found)):
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    files.append(File.generated(config, "index.md", abs_src_path=str(ROOT / "README.md")))
    return files


def in_repository(uri: str) -> str:
    """Where a file of the site is in the repository."""
    if uri == "index.md":
        return "README.md"
    inside = posixpath.join("docs", uri)
    return inside if (ROOT / inside).exists() else uri


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Links between files of the repository as links between files of the site."""
    here = page.file.src_uri
    folder = posixpath.dirname(in_repository(here))

    def moved(match: re.Match[str]) -> str:
        path, mark, anchor = match[2].partition("#")
        if not path or "://" in path or path.startswith("mailto:"):
            return match[0]
        target = posixpath.normpath(posixpath.join(folder, path))
        target = "index.md" if target == "README.md" else target.removeprefix("docs/")
        link = posixpath.relpath(target, posixpath.dirname(here) or ".")
        return f"{match[1]}{link}{mark}{anchor}{match[3]}"

    return LINK.sub(moved, markdown) + ("" if here == "terms.md" else abbreviations())


@functools.cache
def abbreviations() -> str:
    """Return the terms of docs/terms.md for the extension that explains them in each page."""
    text = (ROOT / "docs" / "terms.md").read_text(encoding="utf-8")
    rows = re.findall(r"^- \*\*(.+?)\*\*: (.+)$", text, re.MULTILINE)
    told = (f"*[{term}]: {meaning.replace('`', '')}" for term, meaning in rows)
    return "\n\n" + "\n".join(told)


def on_post_page(output: str, page: Page, **_: Any) -> str:
    """Nothing may come from a network."""
    for found in REMOTE.findall(output):
        log.warning("%s loads from a network: %s", page.file.src_uri, found)
    return output
