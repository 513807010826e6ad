"""Marking the object in the browser: a box, points or paint on a frame.

A page of our own on the standard library's server, so that it works with the core install: viser, which the viewer
uses, can show an image but not take what is drawn on it.
"""
