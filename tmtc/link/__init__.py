"""The link: CADUs, Reed-Solomon, transfer frames, CLCW, uplink, link settings."""
