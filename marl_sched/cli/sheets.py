"""`marl-sched template`, `import` and `fit`: problems and parameters from spreadsheets."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marl_sched.cli import options
from marl_sched.cli.grouped import DOMAIN_OPTIONS, OwnOptions, takes_own
from marl_sched.errors import InvalidFileError, InvalidOptionError, UnknownNameError

if TYPE_CHECKING:
    from marl_sched.domain import Domain
    from marl_sched.domain_parts import Instance
    from marl_sched.sheets import Sheet

ROWS, RECORDS = "rows", "records"


def add_to(app: typer.Typer) -> None:
    """Register this file's commands."""
    app.command(epilog=f"Example: marl-sched template {options.DEFAULT_ENV} --out sheet.csv")(template)
    example = "Example: marl-sched import fleet.csv --crews 5 --out fleet.json"
    app.command("import", epilog=example, context_settings=DOMAIN_OPTIONS)(takes_own(import_sheet))
    example = "Example: marl-sched fit failures.csv --out types.json --plot fit.png"
    app.command(epilog=example, context_settings=DOMAIN_OPTIONS)(takes_own(fit))


def template(
    env: Annotated[str, typer.Argument(help="The environment.")],
    what: Annotated[
        str, typer.Argument(help="rows, records (for `fit`), or a setting that is a file of its own.")
    ] = ROWS,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write it here (default: standard output).")
    ] = None,
) -> None:
    """Write a spreadsheet to begin with: headings, examples, and what every column means."""
    from marl_sched.domain import get_domain
    from marl_sched.files import replacing

    sheet = require_sheet(env)
    templates = {ROWS: sheet.template, **{one.name: one.template for one in sheet.settings if one.template}}
    records = get_domain(env).records
    if records is not None:
        templates[RECORDS] = records.template
    if what not in templates:
        raise UnknownNameError(f"template of {env}", what, templates)
    text = templates[what]()
    if out is None:
        sys.stdout.write(text)
        return
    options.check_output(out, "--out")
    with replacing(out) as temporary:
        temporary.write_text(text, encoding="utf-8")


def import_sheet(
    own: OwnOptions,
    sheet: Annotated[Path, typer.Argument(metavar="FILE.csv", help="The spreadsheet.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The instance as JSON.")],
    env: Annotated[
        str | None, typer.Option("--env", help="The environment (default: the one whose headings the sheet has).")
    ] = None,
) -> None:
    """Read a spreadsheet; what its settings are, such as --crews, `template` shows."""
    options.check_output(out, "--out")
    domain = domain_of_sheet(sheet, env)
    instance = load_sheet(domain, sheet, own)
    instance.save(out)
    options.warn_of_impossible(domain, {str(out): instance})
    typer.echo(out)


def fit(
    own: OwnOptions,
    records: Annotated[Path, typer.Argument(metavar="FILE.csv", help="The records, see `template ENV records`.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="The parameters as JSON, for --types of `import`.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE", help="A picture, in the format of its suffix.")
    ] = None,
    env: options.Env = options.DEFAULT_ENV,
) -> None:
    """Estimate parameters from records of failures, with intervals; parts that have not failed yet count."""
    from marl_sched.cli.tables import print_rows
    from marl_sched.domain import get_domain
    from marl_sched.files import write_json
    from marl_sched.planning import Fitted
    from marl_sched.sheet_reading import read_sheet

    sheet = get_domain(env).records
    if sheet is None:
        raise InvalidOptionError(f"--env: the environment {env!r} has no parameters to fit")
    options.check_output(out, "--out")
    options.check_picture(plot, "--plot")
    fitted: Fitted = read_sheet(sheet, records, own.words)
    print_rows(*fitted.table(), caption=fitted.remark)
    if out is not None:
        write_json(out, fitted.as_json())
        typer.echo(out)
    if plot is not None:
        from marl_sched.train.evaluation.plots import save

        typer.echo(save(fitted.figure(), plot))


def require_sheet(env: str) -> Sheet:
    """What a domain declares of its spreadsheets; InvalidOptionError if it has none."""
    from marl_sched.domain import get_domain

    found = get_domain(env).sheet
    if found is None:
        raise InvalidOptionError(f"--env: the environment {env!r} has no spreadsheets")
    return found


def domain_of_sheet(path: Path, env: str | None) -> Domain:
    """The domain of that name, or the first one whose headings a file has; InvalidFileError if none has."""
    from marl_sched.domain import domain_names, get_domain
    from marl_sched.sheet_reading import has_headings

    if env is not None:
        require_sheet(env)
        return get_domain(env)
    with_sheets = [domain for domain in map(get_domain, domain_names()) if domain.sheet is not None]
    for domain in with_sheets:
        if has_headings(domain.sheet, path):  # type: ignore[arg-type]  # those without were left out
            return domain
    names = ", ".join(domain.name for domain in with_sheets)
    raise InvalidFileError(path, "row 1", f"the headings of one of {names} (--env NAME says what is missing)")


def load_sheet(domain: Domain, path: Path, own: OwnOptions) -> Instance:
    """The instance in a spreadsheet; `own` are texts of settings."""
    from marl_sched.sheet_reading import read_sheet

    instance: Instance = read_sheet(require_sheet(domain.name), path, own.words)
    return instance
