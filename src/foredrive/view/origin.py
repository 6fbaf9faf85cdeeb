"""Where a summary's figures come from."""

from dataclasses import dataclass

from foredrive.view.table import Summary


@dataclass(frozen=True)
class Origin:
    """What was run, of which commit, on which machine and when."""

    command: str
    commit: str
    machine: str
    date: str = ""

    @classmethod
    def of(cls, summary: Summary, date: str = "") -> "Origin":
        """Read it off a summary's provenance."""
        machine = [
            f"{summary.get('machine.cores')} cores of {summary.get('machine.cpu')}",
            f"{summary.get('machine.ram_gib')} GiB",
            summary.get("machine.gpu"),
            f"Python {summary.get('version.python')}",
            f"torch {summary.get('version.torch')}",
        ]
        return cls(
            command=str(summary.get("command")),
            commit=str(summary.get("commit") or "not a git checkout"),
            machine=", ".join(str(part) for part in machine if part),
            date=date,
        )
