"""The style sheet of the page that `report` writes."""

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #111; background: #fff; \
max-width: 68em; margin: 2em auto; padding: 0 1.5em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #999; }
.wide { overflow-x: auto; margin: 1em 0; }
table { border-collapse: collapse; font-size: 0.87em; min-width: 26em; }
caption { text-align: left; font-weight: 600; padding-bottom: 0.4em; white-space: pre-line; }
th, td { border-bottom: 1px solid #ccc; padding: 0.2em 0.7em; text-align: left; \
vertical-align: top; }
thead th { border-bottom: 2px solid #444; vertical-align: bottom; }
.n { text-align: right; font-variant-numeric: tabular-nums; } td.n { white-space: nowrap; }
.date { color: #444; margin-top: -0.6em; } \
.conclusion { background: #f2f6fa; border-left: 4px solid #0072b2; padding: 0.2em 1.2em 0.6em; } \
.conclusion h2 { border: none; margin-top: 0.6em; } .conclusion p { margin: 0.4em 0; } \
.pairs th { font-weight: 500; color: #333; } .pairs td { overflow-wrap: anywhere; } \
details { margin: 1em 0; } summary { cursor: pointer; }
figure { margin: 1.5em 0; } img { max-width: min(100%, 52em); height: auto; } \
figcaption { font-size: 0.87em; color: #333; }
pre, code { font: 0.85em/1.35 ui-monospace, monospace; } \
pre { white-space: pre-wrap; overflow-wrap: anywhere; }
@media print {
  body { font-size: 10pt; max-width: none; margin: 0; padding: 0; }
  .wide { overflow: visible; } table { font-size: 8pt; } th, td { padding: 0.15em 0.4em; }
  tr, figure { break-inside: avoid; } h2, caption { break-after: avoid; } img { max-height: 20cm; }
}
"""
