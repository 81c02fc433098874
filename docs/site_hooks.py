"""Puts the files outside this folder to which the pages link on the site (`mkdocs.yml`)."""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

CHECKOUT = Path(__file__).resolve().parent.parent
_OUTSIDE = re.compile(r"\]\(\.\./([^)#]+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the files at the paths that they have in the checkout."""
    pages = files.documentation_pages()
    for path in sorted({path for page in pages for path in _OUTSIDE.findall(page.content_string)}):
        files.append(File.generated(config, path, abs_src_path=str(CHECKOUT / path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links between pages of this folder and files outside it, from the places on the site."""
    if page.file.generated_by:
        return re.sub(r"\]\((\.\./)?docs/", r"](\1", markdown)
    return markdown.replace("](../", "](")
