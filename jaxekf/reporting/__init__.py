"""Pictures and pages: `plots` draws single figures with matplotlib, `report` one HTML page with plotly.

Nothing below the command line imports it. A new figure is a function in `plots` with the decorator
`plots._registry.figure`.
"""
