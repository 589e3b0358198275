"""The credentials of a site's servers: certificates, users, and what each user may do. Needs the extra `security`."""
