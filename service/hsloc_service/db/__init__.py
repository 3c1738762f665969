"""Database: tables, transactions, migrations."""
