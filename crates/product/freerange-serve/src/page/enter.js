"use strict";
// Before the page: goes on to it from our own site, so that the browser sends the cookie; or lets the form keep which object the link names.
{
  const form = document.querySelector("form");
  if (form) form.action = `/${location.hash}`;
  // Another address than this one: the same would not be asked for again.
  else location.replace(`${location.href.split("#")[0].includes("?") ? "/" : "/?"}${location.hash}`);
}
