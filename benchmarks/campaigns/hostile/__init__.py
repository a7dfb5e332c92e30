"""A hostile payload build, and the profiles under which the service meets it."""
