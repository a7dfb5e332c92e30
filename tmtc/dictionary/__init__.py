"""The packet dictionary of the payload: schema, packets, fields, codes, on-board tables, ICD."""
