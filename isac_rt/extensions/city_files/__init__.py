"""Cities from maps: footprints, CityJSON, tables of GDAL and terrain."""
