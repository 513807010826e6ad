"""Pages about finished runs: one self-contained HTML file each, that needs no network, no server and no plug-in.

They are made from the run folder alone, through `tracking3d.results.run_reader.RunReader`; what is put into them is
escaped by Jinja, and a content security policy lets nothing run but our own script. ``page/`` holds the templates.
"""
