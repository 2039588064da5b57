"""What the pages show works: every block of Python and every command, in order."""

import pytest

from tests.docs.blocks import ROOT, TIMEOUT, blocks, run_page

# The page for planners begins with sheets that its commands read: tests/docs/test_planners.py runs it.
ALL = [page for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")] if page.name != "planners.md"]
PAGES = sorted(page for page in ALL if any(blocks(page)))


@pytest.mark.slow
@pytest.mark.timeout(TIMEOUT)
@pytest.mark.parametrize("page", PAGES, ids=[page.stem for page in PAGES])
def test_every_block_of_the_page_runs(page, tmp_path):
    run_page(page, tmp_path)


def test_pages_with_code_are_found():
    assert {"first-environment", "train", "deploy", "own-fleet", "README"} <= {page.stem for page in PAGES}
