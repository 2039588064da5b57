"""Whether an HTML page is well formed."""

from html.parser import HTMLParser

VOID = {"meta", "br", "hr", "img", "input", "link"}


class _Parser(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open[-1] == tag, f"</{tag}> closes <{self.open[-1]}>"
        self.open.pop()


def assert_well_formed(page: str) -> None:
    """Every element is closed where it should be, and every id is there once."""
    parser = _Parser()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    ids = [part.split('"')[0] for part in page.split(' id="')[1:]]
    assert len(ids) == len(set(ids))
