"""`lfpiv studio`: a local page in the browser that shows rig, images, volume, runs and results.

It needs the extra `studio`. `server` starts the page and guards it. Each tab is a module `*_tab`; what it shows is
computed in modules without a page.
"""
