"""Builders and doubles that tests share; fixtures are in the folders' `conftest.py`."""
