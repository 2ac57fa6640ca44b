# docker build -t barpc:0.5.0 .
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" barpc:0.5.0 adjust left.tif right.tif -o adjusted
FROM python:3.12-slim AS build
WORKDIR /src
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheel .

FROM python:3.12-slim
# rasterio's GDAL looks for the system's libexpat
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends libexpat1 && rm -rf /var/lib/apt/lists/*
RUN --mount=type=bind,from=build,source=/wheel,target=/wheel \
    pip install --no-cache-dir "$(echo /wheel/barpc-*.whl)[report]"
RUN useradd --uid 1000 --create-home barpc
USER 1000
WORKDIR /data
ENTRYPOINT ["barpc"]
