"""Puts the files outside this folder to which the pages link on the site (`mkdocs.yml`), and the
whole API reference."""

import re
from pathlib import Path
from runpy import run_path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

CHECKOUT = Path(__file__).resolve().parent.parent
_OUTSIDE = re.compile(r"\]\(\.\./(?!src/)([^)#]+)")


@event_priority(100)  # before the redirects, whose targets must exist
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the README, which is the home page, and the files that the pages link to, at the paths
    that they have in the checkout."""
    pages = files.documentation_pages()
    outside = {path for page in pages for path in _OUTSIDE.findall(page.content_string)}
    home = (CHECKOUT / "README.md").read_text(encoding="utf-8")
    outside |= {"README.md", *re.findall(r"\]\((?!docs/|http)([^)#]+)", home)}
    for path in sorted(outside):
        files.append(File.generated(config, path, abs_src_path=str(CHECKOUT / path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links between pages of this folder and files outside it, from the places on the site; in
    place of the index of the public names, their whole reference."""
    if page.file.src_uri == "api.md":
        return run_path(str(CHECKOUT / "docs/api_reference.py"))["reference"]()
    if page.file.generated_by:
        return re.sub(r"\]\((\.\./)?docs/", r"](\1", markdown)
    return markdown.replace("](../", "](")
