"""The command line: parses, calls a workflow, prints; nothing else."""

from closerange.apps.cli import match, shapes, volume
from closerange.apps.cli.commands import app
from closerange.apps.cli.examples import epilog

app.command(epilog=epilog("match"))(match.match)
app.command(epilog=epilog("volume"))(volume.volume)
app.add_typer(shapes.app)


def main() -> None:
    """Run the command line."""
    app()


__all__ = ["app", "main"]
