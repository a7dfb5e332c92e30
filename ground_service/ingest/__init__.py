"""From octets of a downlink to stored packets: frames, packets, joining of pieces, accounting."""
