"""What the service does, one module per service: it joins store, link and processing."""
