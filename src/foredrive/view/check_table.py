"""The check of a log as a table."""

from foredrive.data.log_check import Finding, LogCheck, Stream
from foredrive.view.table import Cell, Column, Row, Section, Table


def check_table(check: LogCheck) -> Table:
    """Return the streams of a log, then the findings."""
    problems = sum(finding.level == "problem" for finding in check.findings)
    length = f"{check.frames} frames in {check.duration_s:.1f} s, {check.driven_m:.0f} m driven"
    sections = [Section([_stream_row(stream) for stream in check.streams])]
    if check.findings:
        sections.append(Section([_finding_row(finding) for finding in check.findings], "noticed"))
    return Table(
        [Column(align="left"), Column("frames"), Column("Hz", digits=1), Column(align="left")],
        sections,
        f"{check.log}: {length}; {problems or 'no'} problem{'' if problems == 1 else 's'}",
    )


def _stream_row(stream: Stream) -> Row:
    rate_hz = None if stream.period_s is None else 1 / stream.period_s
    return Row((stream.name, stream.count, rate_hz, stream.detail))


def _finding_row(finding: Finding) -> Row:
    subject = Cell(finding.subject, "bad" if finding.level == "problem" else "")
    return Row((subject, "", "", finding.text))
