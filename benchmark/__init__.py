"""Everything around a run: measurements, pictures, reports."""
