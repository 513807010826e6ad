# tracking3d for the CPU, as a user who is not root, in under 1.5 GB.
#
#   docker build -t tracking3d .
#   docker run --rm -v "$PWD:/data" tracking3d run clip.mp4 --box 301,11,296,227 --out runs/box
#
# Files are written as user 1000; add --user "$(id -u):$(id -g)" where you are another.
FROM python:3.12-slim AS build
WORKDIR /source
RUN python -m venv --without-pip /opt/tracking3d
COPY pyproject.toml setup.py README.md LICENSE constraints.txt ./
COPY configs configs
COPY tracking3d tracking3d
COPY plugins/tracking3d-bench plugins/tracking3d-bench
RUN pip --python /opt/tracking3d install --no-cache-dir --no-compile -c constraints.txt \
    --extra-index-url https://download.pytorch.org/whl/cpu . ./plugins/tracking3d-bench
# What no run needs: headers, and the tests of what was installed.
RUN cd /opt/tracking3d/lib/python3.12/site-packages \
    && rm -rf torch/include torch/test torch/share \
    && find torch/bin -type f ! -name torch_shm_manager -delete \
    && find . -type d -name tests -prune -exec rm -rf {} +

FROM python:3.12-slim
RUN useradd --create-home --uid 1000 tracking3d && mkdir /data && chown tracking3d /data
COPY --from=build /opt/tracking3d /opt/tracking3d
ENV PATH=/opt/tracking3d/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/tmp/numba \
    XDG_CACHE_HOME=/tmp/cache
USER tracking3d
WORKDIR /data
ENTRYPOINT ["tracking3d"]
CMD ["--help"]
