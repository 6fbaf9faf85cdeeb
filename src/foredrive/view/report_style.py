"""The report's style sheet: reads well on light and dark screens and on paper, and loads nothing."""

CSS = """
:root {
  color-scheme: light dark;
  --page: #ffffff; --card: #f5f6f8; --ink: #1b2028; --faint: #5d6878; --line: #dde1e7; --accent: #1769d2;
  --warn: #a64b00; --warn-card: #fff3e4; --best: #0a7a45;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #14181f; --card: #1d232d; --ink: #e4e8ee; --faint: #98a3b3; --line: #323b48; --accent: #6fb1ff;
    --warn: #ffb86b; --warn-card: #33261a; --best: #58d798;
  }
}
* { box-sizing: border-box; }
body {
  margin: 0 auto; padding: 2.2rem 1.6rem 4rem; max-width: 1240px; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", sans-serif;
}
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .9rem; }
h2 { font-size: 1.35rem; margin: 2.8rem 0 .7rem; padding-top: .8rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .5rem; }
p { margin: .4rem 0 .8rem; max-width: 75ch; }
p.note, figcaption, .unit { color: var(--faint); font-size: .88rem; }
code { font: .88em ui-monospace, "SF Mono", Menlo, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere; }
dl.run { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.1rem; margin: 0; }
dl.run dt { color: var(--faint); }
dl.run dd { margin: 0; min-width: 0; overflow-wrap: anywhere; }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(215px, 1fr)); gap: .8rem; }
.tile { background: var(--card); border-radius: 10px; padding: .8rem 1rem; break-inside: avoid; }
.tile .name { color: var(--faint); font-size: .88rem; }
.tile .value { font-size: 1.75rem; font-weight: 650; line-height: 1.3; }
.tile .value small { font-size: .95rem; font-weight: 400; color: var(--faint); }
.alert {
  background: var(--warn-card); border-left: 4px solid var(--warn); border-radius: 6px; padding: .6rem 1rem;
  margin: .8rem 0;
}
.alert strong { color: var(--warn); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .5rem 0 .9rem; font-size: .92rem; }
td, .value { font-variant-numeric: tabular-nums; }
th, td { padding: .32rem .75rem; text-align: right; white-space: nowrap; }
th, td { border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--faint); }
th[scope=row], td.text, th.text { text-align: left; }
th[scope=row] { color: var(--ink); font-weight: 500; }
th.group { text-align: center; }
tr.model th[scope=row], tr.model td { font-weight: 650; }
tbody + tbody tr:first-child > * { border-top: 2px solid var(--line); }
td.best { color: var(--best); }
figure { margin: 0; min-width: 0; break-inside: avoid; }
figure img { display: block; width: 100%; height: auto; border-radius: 6px; background: #11151c; }
figcaption { padding: .3rem .1rem 0; overflow-wrap: anywhere; }
details { margin-top: 2.8rem; }
.grid { display: grid; gap: .7rem; margin: .6rem 0 1rem; align-items: start; }
.grid.two { grid-template-columns: repeat(2, 1fr); }
.grid.three { grid-template-columns: repeat(3, 1fr); }
ul.key { list-style: none; margin: 0 0 .6rem; padding: 0; }
ul.key li { display: flex; align-items: center; gap: .5rem; }
ul.key i { width: .95rem; height: .95rem; border-radius: 3px; border: 1px solid #8888; }
.plan, .later { display: grid; gap: .7rem; margin: .6rem 0 1rem; align-items: start; }
.plan { grid-template-columns: 1.9fr 1fr; }
.later { grid-template-columns: 1.82fr 1fr 1.82fr 1fr; }
svg { width: 100%; height: auto; max-width: 1100px; }
@media screen and (max-width: 760px) {
  .grid.two, .grid.three, .later, .plan { grid-template-columns: 1fr; }
}
@media print {
  :root { --page: #fff; --card: #f5f6f8; --ink: #000; --faint: #444; --line: #bbb; --warn-card: #fff3e4; }
  body { padding: 0; max-width: none; font-size: 10.5pt; print-color-adjust: exact; }
  h2, h3, h3 + p { break-after: avoid; }
  .scroll { overflow: visible; }
  tbody, .grid, .plan, .tiles { break-inside: avoid; }
  details { display: none; }
  table { font-size: 8.5pt; }
  th, td { padding: .2rem .45rem; }
}
"""
