"""What is written to disk and read again: results, archives, tables, fingerprints."""
