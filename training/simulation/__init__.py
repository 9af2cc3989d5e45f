"""The plant driven through manoeuvres: labelled logs without a reference sensor."""
