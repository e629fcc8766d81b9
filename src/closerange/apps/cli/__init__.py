"""The command line: parses, calls a workflow, prints; nothing else."""

from closerange.apps.cli import shapes
from closerange.apps.cli.commands import app

app.add_typer(shapes.app)


def main() -> None:
    """Run the command line."""
    app()


__all__ = ["app", "main"]
