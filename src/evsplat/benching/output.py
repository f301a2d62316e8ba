"""What a bench leaves for readers: tables in three languages and the page."""

from evsplat.benching.figures import Records
from evsplat.benching.folder import BenchFolder
from evsplat.benching.page import page
from evsplat.benching.plan import Plan
from evsplat.benching.tables import make_tables
from evsplat.benching.writers import latex, markdown
from evsplat.files import write_text


def write_output(plan: Plan, folder: BenchFolder) -> None:
    """Write tables.md, tables.tex and index.html of what has been recorded so far."""
    records = Records.read(plan, folder)
    tables = make_tables(records)
    title = plan.suite.title or plan.suite.name
    write_text(folder.path / "tables.md", markdown(title, tables))
    write_text(folder.path / "tables.tex", latex(tables))
    write_text(folder.path / "index.html", page(records, tables, folder))
