"""Compiled inner loops of the evidence; each file belongs to the module of the same name one folder up."""
