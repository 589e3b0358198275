"""Who a process is, and whom it trusts: credentials, certificates, keys and tokens."""
