"""The words of the field, and none of those that the project once had for them, in code and documents."""

from pathlib import Path
import re

import pytest

ROOT = Path(__file__).resolve().parents[3]
#: Replaced word to the field's one.
REPLACED = {
    'told': 'received, published', 'tells': 'shows', 'tell': 'show', 'rival': 'alternative hypothesis',
    'rivals': 'alternative hypotheses', 'astray': 'inconsistent', 'culprit': 'inconsistent', 'stranger': 'unmapped',
    'strangers': 'unmapped', 'smear': 'motion blur', 'smeared': 'blurred', 'sought': 'search scales, estimated',
    'afresh': 'reset', 'clarity': 'contrast-to-noise ratio', 'rim': 'border', 'accused': 'flagged',
    'outgrown': 'relinearised', 'sharpened': 'deblurred', 'honest': 'consistent',
}  # fmt: skip
#: Within names too, which underscores join.
WORD = re.compile(rf'(?<![a-z])({"|".join(REPLACED)})(?![a-z])', re.IGNORECASE)
FILES = [
    path
    for folder in ('thermal_fiducial', 'test', 'doc', 'config', 'launch')
    for path in sorted((ROOT / folder).rglob('*'))
    if path.suffix in ('.py', '.md', '.yaml', '.html') and path != Path(__file__).resolve()
]


@pytest.mark.parametrize('folder', sorted({path.relative_to(ROOT).parts[0] for path in FILES}))
def test_replaced_words_do_not_come_back(folder):
    found = [
        f'{path.relative_to(ROOT)}:{number}: {word[0]}, better {REPLACED[word[0].lower()]}'
        for path in FILES
        if path.relative_to(ROOT).parts[0] == folder
        for number, line in enumerate(path.read_text(encoding='utf-8').splitlines(), start=1)
        for word in WORD.finditer(line)
    ]
    assert found == []
