"""The origin of a summary: command, commit, machine and date."""

from dataclasses import dataclass

from foredrive.view.table import Summary


@dataclass(frozen=True)
class Provenance:
    """The command, commit, machine and date of a summary."""

    command: str
    commit: str
    machine: str
    date: str = ""

    @classmethod
    def of(cls, summary: Summary, date: str = "") -> "Provenance":
        """Return the origin that a summary's provenance states."""
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
