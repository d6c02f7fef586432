"""Hook of the documentation site: its first page is the README, whose links lead from the folder above."""

from pathlib import Path
import re
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The README in place of ``index.md``; links to files outside ``doc/`` become plain text."""
    if page.file.src_uri != 'index.md':
        return markdown
    readme = (ROOT / 'README.md').read_text(encoding='utf-8').replace('](doc/', '](')
    return re.sub(r'\[([^]]+)\]\(LICENSE\)', r'\1', readme)
