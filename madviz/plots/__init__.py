"""Figures for files: bars, dots, tables, lines and curves, as SVG text."""
