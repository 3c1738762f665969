"""Simultaneous localisation and mapping."""
