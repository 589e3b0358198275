"""Redis: versioned records, the audit trail, and what Redis may not lose."""
