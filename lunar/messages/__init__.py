"""Files of ephemerides and attitudes: CCSDS OEM and AEM, STK, SPICE kernels, Horizons tables."""
