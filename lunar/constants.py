"""Physical constants in SI units, each with its source."""

MOON_RADIUS_M = 1_737_400.0
"""Radius of the reference sphere of lunar maps, height models and altitudes (IAU WGCCRE 2009 and 2015)."""

GM_MOON_M3_S2 = 4.902_800_066e12
"""Gravitational parameter of the Moon (JPL DE430 and DE431; Folkner et al. 2014, IPN PR 42-196)."""

GM_EARTH_M3_S2 = 3.986_004_354_36e14
"""Gravitational parameter of the Earth (JPL DE430 and DE431, TDB-compatible)."""

GM_SUN_M3_S2 = 1.327_124_400_419_394e20
"""Gravitational parameter of the Sun (JPL DE430 and DE431, TDB-compatible)."""

EARTH_RADIUS_M = 6_378_136.6
"""Equatorial radius of the Earth (IERS Conventions 2010, table 1.1)."""

SUN_RADIUS_M = 6.957e8
"""Nominal solar radius (IAU 2015 resolution B3)."""

ASTRONOMICAL_UNIT_M = 149_597_870_700.0
"""Astronomical unit (IAU 2012 resolution B2, exact)."""

SPEED_OF_LIGHT_M_S = 299_792_458.0
"""Speed of light in vacuum (SI, exact)."""

SOLAR_PRESSURE_1AU_N_M2 = 1361.0 / SPEED_OF_LIGHT_M_S
"""Radiation pressure of sunlight at 1 au (nominal irradiance 1361 W/m2, IAU 2015 resolution B3)."""

SECONDS_PER_DAY = 86_400.0
NS = 1_000_000_000
"""Nanoseconds in a second."""

DAY_NS = 86_400 * NS
